"""Speed against error of whole fits, of their stages and settings, and the growth of the cost: docs/benchmarks.md.

Usage:
    python benchmarks/bench.py [--quick] [CAPTURE ...] [--output-dir DIR] [--docs DIR]

Every fit is a process of its own, one at a time. Every finished one is a line of DIR/results.jsonl, and is not
repeated: a run that was killed goes on where it was, and a finished one only writes the document again. A fit that
fails is a line too; remove the line to try it again. Captures beside those that are made need ground truth.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import psutil
import tyro
from bench_plan import FULL, QUICK, Point, Scene, growths, trade_offs
from bench_report import write_report

HERE = Path(__file__).parent
QUICK_SECONDS = 17 * 60
"""When a quick run begins no more fits; what is left over is told in the document."""


@dataclasses.dataclass
class Options:
    """What to run."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of captures to try all settings on too."""
    quick: bool = False
    """Minutes instead of hours: two small objects, fewer settings, and nothing is begun after 17 minutes."""
    output_dir: Path = Path("outputs/bench")
    """Folder for captures, bundles and results.jsonl."""
    docs: Path = HERE.parent / "docs"
    """Folder of benchmarks.md."""
    only: str | None = None
    """Fits whose key has this text, for a trial."""


def main(options: Options) -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # with the fit that is running, as Ctrl-C does
    start = time.monotonic()
    extent = QUICK if options.quick else FULL
    folder = options.output_dir.absolute() / ("quick" if options.quick else "full")
    folder.mkdir(parents=True, exist_ok=True)
    settings = trade_offs(extent, [path.absolute() for path in options.captures])
    scene = settings[0].truth or settings[0].scene
    profile = Point("profile", extent.base, scene, quality=extent.base, weight=1.5)
    # One object's settings first: a quick run that ends early has some of everything.
    first = sum(point.seed == 0 and (point.truth or point.scene) == scene for point in settings)
    plan = [*settings[:first], profile, *growths(extent, extent.seeds), *settings[first:]]
    plan = [point for point in plan if options.only is None or options.only in point.key]
    results = folder / "results.jsonl"
    records = read(results)
    kept = sum(point.key in records for point in plan)
    if kept:
        print(f"{kept} of {len(plan)} fits are kept from an earlier run; remove {results} to fit again", flush=True)
    warm = False
    for number, point in enumerate(plan):
        if point.key in records:
            continue
        left = QUICK_SECONDS - (time.monotonic() - start)
        if options.quick and expected_seconds(point, plan, records) > left:
            continue  # a shorter one may fit in
        print(f"{number + 1} of {len(plan)}: {point.key}", flush=True)
        if not warm:  # the first fit of a fresh clone compiles the kernels, which counts for no setting
            run(point, folder)
            warm = True
        records[point.key] = record = run(point, folder)
        with results.open("a") as file:
            file.write(json.dumps(record) + "\n")
    planned = [records.get(point.key) for point in plan]
    write_report(plan, planned, options.docs, machine(), "--quick" if options.quick else "")


def read(results: Path) -> dict[str, dict[str, Any]]:
    """Records by key; a line that a killed run left half written is dropped."""
    records = {}
    for line in results.read_text().splitlines() if results.exists() else []:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        records[record["key"]] = record
    return records


def expected_seconds(point: Point, plan: list[Point], records: dict[str, dict[str, Any]]) -> float:
    """By what fits took so far, with a margin; a minute before there are any."""
    done = [(p.weight, records[p.key]["process_seconds"]) for p in plan if p.key in records]
    if not done:
        return 60.0 * point.weight
    return 1.3 * point.weight * math.fsum(s for _, s in done) / math.fsum(w for w, _ in done)


def run(point: Point, folder: Path) -> dict[str, Any]:
    """Fit and score; the record of it."""
    record: dict[str, Any] = {
        "key": point.key,
        "group": point.group,
        "label": point.label,
        "capture": point.scene.name,
        "size": point.size,
        "seed": point.seed,
        "quality": point.quality,
        "settings": list(point.settings),
        "at": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "busy_before": psutil.cpu_percent(interval=1.0) / 100,
        "machine": machine(),
    }
    start = time.monotonic()
    bundle = folder / "bundle"
    shutil.rmtree(bundle, ignore_errors=True)
    try:
        capture = captured(point.scene, folder)
        start = time.monotonic()
        command = [sys.executable, HERE / "fit_with.py", capture, "--output-dir", bundle]
        command += ["--quality", point.quality, "--seed", point.seed, "--rasterizer", point.rasterizer]
        command += ["--set", *point.settings] if point.settings else []
        command += ["--truth", captured(point.truth, folder)] if point.truth else []
        command += ["--no-score"] if point.of_growth else []
        command += ["--profile"] if point.group == "profile" else []
        subprocess.run([*map(str, command)], check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        told = [line for line in (error.stderr or "").splitlines() if line.strip()]
        return record | {"failed": told[-1] if told else "", "process_seconds": time.monotonic() - start}
    return record | {"process_seconds": time.monotonic() - start} | figures(bundle)


def captured(scene: Scene, folder: Path) -> Path:
    """The folder of a scene's capture, rendered if it is not there."""
    if not scene.made:
        return Path(scene.source)
    capture = folder / "captures" / "_".join((scene.source, *scene.flags)).replace("--", "")
    if not (capture / "ground_truth.json").exists():
        shutil.rmtree(capture, ignore_errors=True)
        (folder / "captures").mkdir(exist_ok=True)
        source = scene.synth_source(folder / "captures")
        command = [sys.executable, "-c", "from splatart_ns.cli import main; main()", "synth", source]
        subprocess.run(
            [*command, "--output-dir", str(capture), *scene.flags], check=True, capture_output=True, text=True
        )
        shutil.rmtree(capture / "eval", ignore_errors=True)  # fitting held-out configurations is another benchmark
    return capture


def figures(bundle: Path) -> dict[str, Any]:
    """Seconds, sizes and errors of a bundle."""
    report, seconds = (json.loads((bundle / name).read_text()) for name in ("report.json", "seconds.json"))
    stages = report["stages"]
    out = {
        "seconds": seconds["all"],
        "import_seconds": seconds["imports"],
        "stage_seconds": {
            name: math.fsum(s["wall_seconds"] for s in stages if s["name"].startswith(name))
            for name in ("semantic", "pose", "joint")
        },
        "gaussians": stages[-1]["gaussians"],
        "peak_memory_mb": max(s["peak_memory_mb"] for s in stages),
        "threads": report["threads"],
        "rasterizer": report["rasterizer"],
        "versions": report["versions"],
    }
    if (bundle / "profile.json").exists():
        out["profile"] = json.loads((bundle / "profile.json").read_text())
    if (bundle / "metrics.json").exists():
        out["errors"] = errors(json.loads((bundle / "metrics.json").read_text()))
    return out


def errors(metrics: dict[str, Any]) -> dict[str, float | None]:
    """Means over joints and test views; None where a joint is missing or of a type without an axis."""
    joints, views = metrics["joints"], [v for name, v in metrics["images"].items() if name.startswith("state")]
    return {
        "motion": mean([j["displacement_percent"] for j in joints]),
        "axis": mean([j["axis_angle"] for j in joints]),
        "image": mean([10 ** (-v["psnr"] / 20) for v in views]),
        "parts": mean([1 - v["part_iou"] for v in views]),
        "wrong joints": float(sum(not (j["type_correct"] and j["parent_correct"]) for j in joints)),
    }


def mean(values: list[float | None]) -> float | None:
    return math.fsum(values) / len(values) if values and None not in values else None


def machine() -> dict[str, Any]:
    """What timings depend on; no names."""
    # A run that goes on where it was finds the document of the first changed.
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":/!docs")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "commit": _git("rev-parse", "--short", "HEAD") + ("-dirty" if changed else ""),
        "cores": cores,
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
        "python": platform.python_version(),
        "architecture": platform.machine(),
    }


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=HERE, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    main(tyro.cli(Options))
