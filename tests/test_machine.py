"""What this machine lends."""

import pytest

from splatart_ns.machine import gpu_memory_mb


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
