"""Joints, trees and confidence over many random objects: a capture, a fit and its errors for each seed.

Usage:
    python benchmarks/captures.py --seeds 0 20 --output-dir /somewhere

Every step runs in a process of its own, by the real command, and what is already there is kept: start it
again to go on. A fit that fails is a row with its reason, and is tried again the next time. `rows_<quality>.json`
in the output folder holds all figures.
"""

import json
import math
import re
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

COLUMNS = {
    "seed": "seed",
    "object": "object",
    "parts": "parts",
    "tree_exact": "tree",
    "types_right": "types\nright",
    "axis_angle_worst": "axis deg\nworst",
    "axis_angle_median": "axis deg\nmedian",
    "axis_position_worst": "axis pos\n0.1 R",
    "turn_mean": "turn\ndeg",
    "slide_mean": "slide\n% R",
    "covered_95": "in\n95 %",
    "psnr": "PSNR\ndB",
    "seconds": "wall seconds:\nsemantic + pose + joint",
}
WIDTH = 128
STAGES = ("semantic", "pose", "joint")


@dataclass
class Options:
    """What to make and fit."""

    output_dir: Path
    """Folder for captures and bundles; what is finished in it is not repeated."""
    seeds: tuple[int, int] = (0, 20)
    """The first seed, and the one after the last."""
    resolution: int = 256
    """Pixels along each side of an image."""
    views: int = 40
    """Training views per state."""
    test_views: int = 4
    """Test views per state."""
    states: int = 2
    """Configurations of each object."""
    quality: str = "standard"
    """Of `splatart fit`."""


def main(options: Options) -> None:
    rows: list[dict[str, Any]] = []
    path = options.output_dir / f"rows_{options.quality}.json"
    for seed in range(*options.seeds):
        try:
            row = {"seed": seed, **measure(seed, options)}
        except subprocess.CalledProcessError as error:
            told = [line.strip() for line in error.stderr.splitlines() if re.search(r"\w", line)]
            reason = told[-1] if told else f"exit code {error.returncode}"
            row = {"seed": seed, "failed": f"splatart {error.cmd[3]}: {reason}"}
        rows.append(row)
        path.write_text(json.dumps({"totals": totals(rows), "rows": rows}, indent=1) + "\n")
        print(f"seed {seed}: {row.get('failed') or row['object']}", file=sys.stderr, flush=True)
    console = Console(width=WIDTH)
    console.print(table(rows))
    for row in (r for r in rows if "failed" in r):
        console.print(f"seed {row['seed']}: {row['failed']}")
    for name, value in totals(rows).items():
        console.print(f"{name}: {text(value)}")


def measure(seed: int, options: Options) -> dict[str, Any]:
    """The figures of one seed, from the files of its bundle once they are there."""
    name = f"random-{seed}_{options.states}x{options.views}x{options.resolution}"
    capture = options.output_dir / "captures" / name
    bundle = options.output_dir / "bundles" / f"{name}_{options.quality}"
    if not (capture / "ground_truth.json").exists():
        numbers = {"states": options.states, "train-views": options.views, "test-views": options.test_views}
        numbers["resolution"] = options.resolution
        flags = [x for key, value in numbers.items() for x in (f"--{key}", value)]
        splatart("synth", f"random-{seed}", "--output-dir", capture, *flags)
    if not (bundle / "metrics.json").exists():
        splatart("fit", capture, "--output-dir", bundle, "--quality", options.quality)
        splatart("eval", bundle, "--data", capture)
    files = (capture / "ground_truth.json", bundle / "metrics.json", bundle / "report.json")
    return figures(*(json.loads(file.read_text()) for file in files))


def figures(truth: dict[str, Any], metrics: dict[str, Any], report: dict[str, Any]) -> dict[str, Any]:
    """A row. Lengths are shares of the object's bounding radius, for objects are of all sizes."""
    joints, radius = metrics["joints"], truth["cameras"]["object_bounding_radius"]
    angles = known(joints, "axis_angle")
    views = [v for name, v in metrics["images"].items() if name.startswith("state")]
    stages = {s: sum(x["wall_seconds"] for x in report["stages"] if x["name"].startswith(s)) for s in STAGES}
    return {
        "object": truth["source"]["robot_name"],
        "parts": len(truth["parts"]),
        "joints": len(joints),
        "tree_exact": metrics["structure"]["tree_exact"],
        "types_right": sum(bool(j["type_correct"]) for j in joints),
        "parents_right": sum(bool(j["parent_correct"]) for j in joints),
        "axis_angles": angles,
        "axis_angle_worst": max(angles, default=None),
        "axis_angle_median": statistics.median(angles) if angles else None,
        "axis_position_worst": max((x / radius for x in known(joints, "axis_position")), default=None),
        "turn_mean": mean(known(joints, "motion_geodesic", "revolute")),
        "slide_mean": mean([100.0 * x / radius for x in known(joints, "motion_geodesic", "prismatic")]),
        "displacement_mean": mean(known(joints, "displacement_percent")),
        # A joint that is missing is not in its region.
        "inside_95": sum(j["covered_95"] is True for j in joints),
        "psnr": mean(known(views, "psnr")),
        "seconds": stages,
        "seconds_total": report["seconds"],
    }


def totals(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all seeds; a failed one has no right tree."""
    done = [r for r in rows if "failed" not in r]
    angles = [x for r in done for x in r["axis_angles"]]
    joints = sum(r["joints"] for r in done)
    return {
        "captures": len(rows),
        "failed": len(rows) - len(done),
        "share with tree_exact": sum(r["tree_exact"] is True for r in done) / len(rows),
        "joints": joints,
        "share of types right": sum(r["types_right"] for r in done) / joints if joints else None,
        "joints without an axis": joints - len(angles),
        "axis angle, worst, deg": max(angles, default=None),
        "axis angle, median, deg": statistics.median(angles) if angles else None,
        "axis angle, mean, deg": mean(angles),
        "axis position, worst, 0.1 R": max(known(done, "axis_position_worst"), default=None),
        "share of truths inside their 95 % regions": sum(r["inside_95"] for r in done) / joints if joints else None,
        "PSNR, mean, dB": mean(known(done, "psnr")),
        "fit, mean, s": mean(known(done, "seconds_total")),
    }


def table(rows: list[dict[str, Any]]) -> Table:
    out = Table(*COLUMNS.values(), box=SIMPLE_HEAD, pad_edge=False)
    for row in (r for r in rows if "failed" not in r):
        shown = {
            **row,
            "types_right": f"{row['types_right']} of {row['joints']}",
            "covered_95": f"{row['inside_95']} of {row['joints']}",
            "seconds": " + ".join(f"{s:.0f}" for s in row["seconds"].values()),
        }
        out.add_row(*(text(shown[key]) for key in COLUMNS))
    return out


def known(records: list[dict[str, Any]], key: str, type: str | None = None) -> list[float]:
    return [r[key] for r in records if r[key] is not None and type in (None, r.get("type"))]


def mean(values: list[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None


def text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def splatart(*arguments: object) -> None:
    command = [sys.executable, "-c", "from splatart_ns.cli import main; main()", *map(str, arguments)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
