"""The same on a Ray cluster, of which a node may go."""

import contextlib
import os
import socket
import sys
import time
from pathlib import Path

import pytest
from stub_recipe import StubRecipe

from splatart_ns.batch.cluster import RayCluster
from splatart_ns.errors import InputError

ray = pytest.importorskip("ray", reason="Ray is not installed: extra 'ray'")


@pytest.fixture
def two_nodes(monkeypatch):
    """A local cluster of a head and another node, a core each."""
    from ray.cluster_utils import Cluster

    here = [str(Path(__file__).parent), *filter(None, sys.path)]  # where tasks find their recipe
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(here))
    known = ray._private.services.get_node

    def patient(*arguments):  # Ray gives a node 30 seconds to start, too few on a busy machine
        for _ in range(120):
            with contextlib.suppress(RuntimeError):
                return known(*arguments)
            time.sleep(1)
        return known(*arguments)

    monkeypatch.setattr(ray._private.services, "get_node", patient)
    try:
        light = {"num_cpus": 1, "include_log_monitor": False, "no_monitor": True}
        cluster = Cluster(initialize_head=True, head_node_args={"include_dashboard": False, **light, **free_ports()})
        other = cluster.add_node(**light, **free_ports())
    except OSError as error:  # no sockets, processes or shared memory for it
        pytest.skip(f"Ray cannot start here: {error}")
    yield cluster, other
    ray.shutdown()
    cluster.shutdown()


def free_ports():
    """For a node's agents: it does not wait until they tell which they took."""
    agents = ("runtime_env_agent", "metrics_agent", "metrics_export", "dashboard_agent_listen")
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in agents]
    ports = {f"{agent}_port": one.getsockname()[1] for agent, one in zip(agents, sockets, strict=True)}
    for one in sockets:
        one.close()
    return ports


def contents(folder):
    """Of all bundles; seconds differ."""
    return {
        file.relative_to(folder): file.read_bytes()
        for file in folder.glob("*/**/*")
        if file.is_file() and file.parent.name != "stages"
    }


def test_a_node_that_dies_changes_nothing(two_nodes, captures, run, tmp_path, log):
    cluster, other = two_nodes
    entries = captures(*(f"object {number}" for number in range(12)))
    seen = []

    class Watched(RayCluster):
        def wait(self, seconds):
            ended = super().wait(seconds)
            seen.extend(ended)
            if len(seen) >= 10 and other in cluster.list_all_nodes():
                cluster.remove_node(other, allow_graceful=False)
            return ended

    recipe = StubRecipe(str(tmp_path / "log"), seconds=0.05)
    told = run(entries, recipe=recipe, engine=Watched(cluster.address))
    assert other not in cluster.list_all_nodes()
    assert set(told.status().values()) == {"done"} and len(told.rows) == 12
    assert set(log()) == {
        f"object {n} {stage}" for n in range(12) for stage in ("look", "copy one", "copy two", "join")
    }
    run(entries, tmp_path / "here", StubRecipe())
    assert contents(tmp_path / "out") == contents(tmp_path / "here")


def test_an_address_where_nothing_is(monkeypatch):
    with pytest.raises(InputError, match="127.0.0.1:1"):
        RayCluster("127.0.0.1:1")
