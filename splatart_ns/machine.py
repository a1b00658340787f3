"""What this machine lends to a computation."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from pathlib import Path

CALM_THREADS = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}
"""Environment in which small work wakes no threads; torch and NumPy read it when they are imported.

A spinning OpenMP pool makes two busy processes on one machine many times slower. OpenBLAS shares even the inverse of a
4x4 matrix between threads, which takes it 15 times as long (5 us in place of 0.3).
"""
_CGROUP = Path("/sys/fs/cgroup")
"""Where Linux says what a container may use."""


def num_cores() -> int:
    """Cores that this process may use: OMP_NUM_THREADS where it is set, else those it is bound to, or fewer where its
    container has less time of them."""
    threads = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]  # "4,2" is for nested regions
    if threads.isdigit():
        return max(1, int(threads))
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(bound, _quota()))


def memory_mb() -> int:
    """Memory of this machine, or of the container that this process runs in, in MiB."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = _told("memory.max") or _told("memory/memory.limit_in_bytes")  # of version 2 of cgroups, of version 1
    return (min(memory, int(limit)) if limit.isdigit() else memory) // 2**20


def _quota() -> float:
    """Cores whose whole time this container may take; infinite where nothing limits it."""
    # By version 2 of cgroups, else by version 1: "max" and -1 are no limit.
    told = _told("cpu.max") or f"{_told('cpu/cpu.cfs_quota_us')} {_told('cpu/cpu.cfs_period_us')}"
    quota, _, period = told.partition(" ")
    return int(quota) // int(period) if quota.isdigit() and period.isdigit() and int(period) else math.inf


def _told(name: str) -> str:
    """A file of the cgroup; "" where there is none."""
    file = _CGROUP / name
    return file.read_text().strip() if file.is_file() else ""


def gpu_memory_mb() -> dict[str, int]:
    """CUDA devices that this process may use, as CUDA_VISIBLE_DEVICES names them, each with its memory in MiB, that of
    the smallest for all; 0 where it is not known, as for a part of a GPU (MIG). Found without loading CUDA."""
    sizes: list[int] = []
    if shutil.which("nvidia-smi") is not None:
        query = ["nvidia-smi", "--query-gpu=memory.total,mig.mode.current", "--format=csv,noheader,nounits"]
        told = subprocess.run(query, capture_output=True, text=True, check=False)
        for line in told.stdout.splitlines() if told.returncode == 0 else ():
            size, _, mig = line.partition(", ")
            sizes.append(int(size) if size.isdigit() and mig != "Enabled" else 0)
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = [str(i) for i in range(len(sizes))] if visible is None else [name.strip() for name in visible.split(",")]
    return {name: min(sizes, default=0) for name in names if name not in ("", "-1")}


def process_lives(pid: int) -> bool:
    """Whether a process of this machine runs."""
    if pid <= 0:  # which would ask for a group of processes
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it is somebody else's
        return True
    return True
