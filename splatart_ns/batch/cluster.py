"""A Ray cluster that runs stages."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from splatart_ns.batch.pool import THREADS, Death
from splatart_ns.batch.stage import Needs
from splatart_ns.errors import InputError, first_line

_RETRIES = 5
"""Times that a task is started again when its node or process dies."""
_WAITING = 2
"""Tasks handed to Ray for each core: enough that no core waits for the driver."""


class RayCluster:
    """Tasks of Ray, on the cluster at an address ("auto", "ray://host:port", or "host:port").

    Raises:
        InputError: Ray is not installed, or nothing answers at the address.
    """

    def __init__(self, address: str):
        try:
            import ray
        except ImportError:
            raise InputError("--address needs Ray; `pip install 'splatart-ns[ray]'`.") from None
        self._ray = ray
        try:
            _knock(address)
            ray.init(address=address, log_to_driver=False, logging_level="ERROR", runtime_env={"env_vars": THREADS})
        except (OSError, ValueError, RuntimeError) as error:
            found = f"no Ray cluster can be used there ({first_line(error)})"
            raise InputError(f"--address {address}: {found}.") from None
        self._task = ray.remote(_call)
        self._tickets: dict[Any, Any] = {}
        self._look()

    def _look(self) -> None:
        """How large the cluster is, which may change."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        self._cores = int(sum(node.get("CPU", 0) for node in nodes))
        self.gpus = int(sum(node.get("GPU", 0) for node in nodes))
        self._memory = int(max((node.get("memory", 0) for node in nodes), default=0))

    def fits(self, needs: Needs) -> bool:
        return len(self._tickets) < _WAITING * max(self._cores, 1)

    def start(self, ticket: Any, needs: Needs, function: Callable, *arguments: Any) -> None:
        reference = self._task.options(
            num_cpus=1,
            num_gpus=1 if needs.gpu and self.gpus else 0,
            memory=min(needs.memory_mb * 2**20, self._memory),  # more than any node has would wait for ever
            max_retries=_RETRIES,
        ).remote(function, *arguments)
        self._tickets[reference] = ticket

    def wait(self, seconds: float) -> list[tuple[Any, Any]]:
        if not self._tickets:
            return []
        ended, others = self._ray.wait(list(self._tickets), num_returns=1, timeout=seconds)
        if ended and others:
            ended += self._ray.wait(others, num_returns=len(others), timeout=0)[0]
        if not ended:
            self._look()
        results = []
        for reference in ended:
            try:
                result = self._ray.get(reference)
            except self._ray.exceptions.RayError as error:
                lines = str(error).strip().splitlines() or [type(error).__name__]
                result = Death(f"Ray gave it up: {lines[-1].strip()}"[:500])
            results.append((self._tickets.pop(reference), result))
        return results

    def close(self) -> None:
        for reference in self._tickets:
            self._ray.cancel(reference, force=True)
        self._ray.shutdown()


def _knock(address: str) -> None:
    """Raise OSError where nothing listens: Ray tries for minutes, and then ends the process."""
    parts = urlsplit(address if "://" in address else f"//{address}")
    if parts.port is not None:
        socket.create_connection((parts.hostname, parts.port), timeout=10).close()


def _call(function: Callable, *arguments: Any) -> Any:
    return function(*arguments)
