"""What a batch costs besides its fits: scheduling of very many objects, and the overhead over single fits.

Usage:
    python benchmarks/batch.py scheduling --objects 10000 --output-dir /somewhere
    python benchmarks/batch.py overhead --captures CAPTURE CAPTURE --output-dir /somewhere
    python benchmarks/batch.py cluster --captures CAPTURE CAPTURE --output-dir /somewhere

`scheduling` runs stages that write tiny files, once to make them and once more with nothing to do. `overhead` runs
`splatart fit` of each capture and then `splatart batch` of all, on one core. `cluster` fits on a local Ray cluster of
two nodes of which one is killed, and compares all bundles with those of a batch on this machine.
"""

import json
import os
import resource
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from splatart_ns.batch.batch import run_batch
from splatart_ns.batch.cluster import RayCluster
from splatart_ns.batch.entry import Entry, read_entries
from splatart_ns.batch.fitting import Fitting
from splatart_ns.batch.pool import ProcessPool
from splatart_ns.batch.report import Report
from splatart_ns.batch.stage import Needs, Stage, Work, fingerprint, stage_key
from splatart_ns.batch.storage import open_storage

SPLATART = [sys.executable, "-c", "from splatart_ns.cli import main; main()"]


@dataclass(frozen=True)
class Tiny:
    """Six stages as those of a fit, which write a line each."""

    def fingerprint(self, entry: Entry) -> str:
        return fingerprint(entry.capture)

    def stages(self, entry: Entry, fingerprint: str, told: dict[str, Any] | None) -> list[Stage]:
        tiny = Needs(memory_mb=1)
        check = Stage("check", stage_key("check", fingerprint), (), tiny)
        if told is None:
            return [check]
        semantic = [Stage(f"semantic {n}", stage_key(check.key, n), ("check",), tiny) for n in (0, 1)]
        pose = Stage("pose", stage_key("pose", check.key), tuple(stage.name for stage in semantic), tiny)
        joint = Stage("joint", stage_key("joint", check.key), ("pose",), tiny)
        return [check, *semantic, pose, joint, Stage("summary", stage_key("summary", check.key), ("joint",), tiny)]

    def run(self, stage: str, work: Work) -> tuple[dict[str, Any], list[str]]:
        (work.folder / f"{stage}.txt").write_text(stage)
        return {}, [f"{stage}.txt"]

    def row(self, entry: Entry, outcomes: dict[str, dict[str, Any]]) -> dict[str, Any]:
        return {"parts": [], "joints": [], "failed_checks": []}


class Count:
    """Counts objects, and notes the driver's memory as they come."""

    def __init__(self, entries: list[Entry]):
        self.report, self.total, self.memory = Report(entries), len(entries), {}

    def started(self, entry, stage):
        pass

    def ended(self, entry, stage, marker):
        if marker.failed:
            print(f"{entry.name}, {stage}: {marker.failed}", file=sys.stderr)

    def finished(self, index, row):
        self.report.add(index, row)
        done = sum(self.report.counts.values())
        if done in (self.total // 10, self.total):
            self.memory[done] = resident_mb()


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def scheduling(output_dir: Path, objects: int = 10_000) -> None:
    """Objects of tiny stages: seconds an object, the driver's own, and its memory."""
    captures, out = output_dir / "captures", open_storage(str(output_dir / "out"))
    for number in range(objects):
        folder = captures / f"{number // 1000:03d}" / f"{number:06d}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "capture.txt").write_text(str(number))
    manifest = output_dir / "list.csv"
    manifest.write_text("path\n" + "".join(f"captures/{n // 1000:03d}/{n:06d}\n" for n in range(objects)))
    settings = {"quality": "draft", "root": None, "seed": 0, "downscale": None, "joints": []}
    for what in ("first run", "nothing to do"):
        start, cpu = time.perf_counter(), time.process_time()
        entries = read_entries(str(manifest), settings)
        count = Count(entries)
        run_batch(entries, out.url, Tiny(), ProcessPool(), count)
        count.report.write(out)
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        memory = ", ".join(f"{mb:.0f} MB after {done}" for done, mb in count.memory.items())
        each = f"{1000 * seconds / objects:.2f} ms an object ({1000 * cpu / objects:.2f} of the driver's CPU)"
        print(f"{what}: {seconds:.1f} s, {each}; driver {memory}; {dict(count.report.counts)}", flush=True)


def overhead(captures: list[Path], output_dir: Path, quality: str = "draft") -> None:
    """The same captures by single fits and by a batch, on one core."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    source = output_dir / "list.jsonl"
    source.parent.mkdir(parents=True, exist_ok=True)
    source.write_text("".join(json.dumps({"path": str(capture.resolve())}) + "\n" for capture in captures))
    single = 0.0
    for capture in captures:
        folder = output_dir / "single" / capture.name
        single += timed([*SPLATART, "fit", capture, "--output-dir", folder, "--quality", quality], environment)
    out = output_dir / "batch"
    batch = timed([*SPLATART, "batch", source, "--output-dir", out, "--quality", quality], environment)
    print(
        f"{len(captures)} single fits {single:.1f} s CPU, batch {batch:.1f} s CPU: {100 * (batch / single - 1):+.1f} %"
    )
    compare(output_dir / "single", out)


def timed(command: list[Any], environment: dict[str, str]) -> float:
    """Seconds of CPU of a command and its children, which other work on the machine changes least."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    subprocess.run([*map(str, command)], env=environment, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{command[3]} {command[4]}: {time.perf_counter() - start:.1f} s, {cpu:.1f} s CPU", flush=True)
    return cpu


def cluster(captures: list[Path], output_dir: Path, quality: str = "draft") -> None:
    """A local Ray cluster of two nodes, one of them killed when a third of the stages have ended."""
    from ray.cluster_utils import Cluster

    settings = {"quality": quality, "root": None, "seed": 0, "downscale": None, "joints": []}
    entries = [Entry(capture.name, str(capture.resolve()), settings) for capture in captures]
    here, there = open_storage(str(output_dir / "here")), open_storage(str(output_dir / "there"))
    count = Count(entries)
    run_batch(entries, here.url, Fitting(), ProcessPool(), count)
    print(f"this machine: {dict(count.report.counts)}", flush=True)
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    other = nodes.add_node(num_cpus=1)

    class Watched(Count):
        left = 2 * len(entries)

        def ended(self, entry, stage, marker):
            super().ended(entry, stage, marker)
            self.left -= 1
            if self.left == 0:
                print(f"killing a node after {entry.name}: {stage}", flush=True)
                threading.Thread(target=nodes.remove_node, args=(other, False)).start()

    count = Watched(entries)
    run_batch(entries, there.url, Fitting(), RayCluster(nodes.address), count)
    print(f"cluster: {dict(count.report.counts)}", flush=True)
    compare(output_dir / "here", output_dir / "there")
    nodes.shutdown()


def compare(one: Path, other: Path) -> None:
    """Say how many bundles are the same bit for bit."""
    bundles = sorted(path.parent for path in one.glob("*/articulation.json"))
    same = 0
    for bundle in bundles:
        files = [bundle / "articulation.json", *(bundle / "parts").iterdir()]
        same += all(file.read_bytes() == (other / file.relative_to(one)).read_bytes() for file in files)
    print(f"{same} of {len(bundles)} bundles are the same bit for bit")


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"scheduling": scheduling, "overhead": overhead, "cluster": cluster})
