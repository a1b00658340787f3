"""What this machine lends."""

import os

import pytest

from splatart_ns import machine
from splatart_ns.machine import gpu_memory_mb, memory_mb, num_cores


@pytest.fixture
def container(tmp_path, monkeypatch):
    """Makes a container's limits, contents by files, on a machine of eight cores."""
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)

    def make(limits):
        for name, text in limits.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text)

    return make


@pytest.mark.parametrize(
    ("limits", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000\n"}, 8),
        ({"cpu.max": "200000 100000\n"}, 2),
        ({"cpu.max": "350000 100000\n"}, 3),
        ({"cpu.max": "50000 100000\n"}, 1),
        ({"cpu.max": "1600000 100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
    ],
)
def test_cores_are_those_that_a_container_may_use_the_whole_time(container, limits, cores):
    container(limits)
    assert num_cores() == cores


def test_the_user_says_how_many_cores_a_container_has(container, monkeypatch):
    container({"cpu.max": "200000 100000"})
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert num_cores() == 5


def test_memory_is_that_of_a_container(container):
    container({"memory.max": f"{64 * 2**20}\n"})
    assert memory_mb() == 64
    container({"memory.max": "max\n"})
    assert memory_mb() > 64


def test_memory_of_a_container_by_version_1_of_cgroups(container):
    container({"memory/memory.limit_in_bytes": f"{64 * 2**20}\n"})
    assert memory_mb() == 64
    container({"memory/memory.limit_in_bytes": "9223372036854771712\n"})
    assert memory_mb() > 64


@pytest.fixture
def listed(tmp_path, monkeypatch):
    """Makes an nvidia-smi that prints so."""

    def make(lines, code=0):
        tool = tmp_path / "nvidia-smi"
        tool.write_text(f"#!/bin/sh\ncat <<END\n{lines}\nEND\nexit {code}\n")
        tool.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=":")

    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    return make


def test_gpus_are_counted_with_the_memory_of_the_smallest(listed):
    listed("81559, Disabled\n24564, [N/A]")
    assert gpu_memory_mb() == {"0": 24564, "1": 24564}


def test_gpus_that_the_user_grants(listed, monkeypatch):
    listed("24564, [N/A]\n24564, [N/A]")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1, GPU-12")
    assert gpu_memory_mb() == {"1": 24564, "GPU-12": 24564}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert gpu_memory_mb() == {}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
    assert gpu_memory_mb() == {}


@pytest.mark.parametrize("line", ["81559, Enabled", "[N/A], [N/A]"])
def test_the_memory_of_a_divided_gpu_is_not_known(listed, line):
    listed(line)
    assert gpu_memory_mb() == {"0": 0}


def test_a_tool_that_finds_no_driver_lists_no_gpu(listed):
    listed("NVIDIA-SMI has failed", code=9)
    assert gpu_memory_mb() == {}
