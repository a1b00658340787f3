"""All that touches nerfstudio's private behaviour."""

from __future__ import annotations

import random
import sys
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
import yaml
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.utils import writer
from nerfstudio.viewer.viewer_elements import ViewerControl

from splatart_ns.errors import InputError


def allow_checkpoint_scalars() -> None:
    """Let `torch.load(weights_only=True)` read nerfstudio's checkpoints.

    Its schedulers store NumPy scalars, which torch >= 2.6 refuses by default. They hold a number and nothing else.
    """
    torch.serialization.add_safe_globals([np.core.multiarray.scalar, np.dtype, type(np.dtype("float64"))])


def report_input_errors() -> None:
    """Let nerfstudio's commands end with one sentence and exit code 2 where an `InputError` ends them.

    Only what nobody catches comes here: `splatart fit` and notebooks get the exception itself.
    """
    previous = sys.excepthook

    def report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, InputError):
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2)  # Python honours it here, as anywhere
        previous(kind, error, trace)

    sys.excepthook = report


def seed_everything(seed: int) -> None:
    """What `ns-train` does with `machine.seed` before it starts."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def stop_event_writers() -> None:
    """Let a trainer that was set up write no events: they cost a tenth of a small capture's step."""
    writer.EVENT_WRITERS.clear()


@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam in one kernel; nerfstudio hands all fields to torch."""

    fused: bool = True
    """One pass over memory in place of a dozen."""


class _TagBlindLoader(yaml.SafeLoader):
    """Reads nerfstudio's config.yml as plain data; Python tags build nothing."""


def _plain(loader: yaml.SafeLoader, _suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_TagBlindLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def read_run_config(config: Path) -> dict[str, Any]:
    """The fields of a run's config.yml, nested dicts and lists of plain values. Nothing is executed.

    Raises:
        InputError: when the file cannot be read.
    """
    try:
        fields = yaml.load(config.read_text(), Loader=_TagBlindLoader)  # a SafeLoader: builds plain values only
    except (OSError, yaml.YAMLError) as error:
        raise InputError(f"{config} cannot be read as a nerfstudio config ({error}); train that stage again.") from None
    if not isinstance(fields, dict):
        raise InputError(f"{config} does not hold a nerfstudio config; train that stage again.")
    return fields


def read_checkpoint(config: Path) -> dict[str, torch.Tensor]:
    """The pipeline state of the newest checkpoint beside a run's config.yml.

    Raises:
        InputError: when there is none or it cannot be read.
    """
    folder = config.parent / "nerfstudio_models"
    files = sorted(folder.glob("step-*.ckpt"))
    if not files:
        raise InputError(f"{folder} holds no checkpoint (step-*.ckpt); train that stage again.")
    try:
        return torch.load(files[-1], map_location="cpu", weights_only=True)["pipeline"]
    except Exception as error:  # torch raises many types for a broken file
        raise InputError(f"{files[-1]} cannot be read ({type(error).__name__}); train that stage again.") from None


def finished_runs(capture: Path, method: str) -> list[Path]:
    """The config.yml of every run of a method on a capture under outputs/ that left a checkpoint, oldest first."""
    configs = Path("outputs").glob(f"*/{method}/*/config.yml")
    finished = [c for c in configs if any((c.parent / "nerfstudio_models").glob("step-*.ckpt"))]
    on_capture = [c for c in finished if _data_of(read_run_config(c)).resolve() == capture.resolve()]
    return sorted(on_capture, key=lambda config: config.stat().st_mtime)


def _data_of(run: dict[str, Any]) -> Path:
    """Where the data of a run are; paths are lists of their parts in config.yml."""
    datamanager = run["pipeline"]["datamanager"]
    return Path(*(datamanager["data"] or datamanager["dataparser"]["data"] or ()))


class StartView(ViewerControl):
    """Shows who connects to the viewer an object of radius 1 about the origin as a whole."""

    DISTANCE = 1.8

    def __init__(self, direction: np.ndarray):
        self.position = self.DISTANCE * direction / np.linalg.norm(direction)

    def _setup(self, viewer) -> None:
        super()._setup(viewer)
        self.viser_server.on_client_connect(self._place)

    def _place(self, client) -> None:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

        with client.atomic():
            client.camera.position = VISER_NERFSTUDIO_SCALE_RATIO * self.position
            client.camera.look_at = np.zeros(3)


allow_checkpoint_scalars()
report_input_errors()
