"""Speed against error of whole fits: captures with ground truth, at several qualities.

Usage:
    python benchmarks/fit.py CAPTURE [CAPTURE ...] --quality draft standard --output-dir /somewhere

Every fit runs in a process of its own, by the real command. Errors are means over the
joints; "right" counts joints with the right type and parent.
"""

import json
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

COLUMNS = ("capture", "quality", "s", "axis\ndeg", "turn\ndeg", "slide\n% R", "right", "PSNR\ndB", "part\nIoU")


@dataclass
class Options:
    """What to fit."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of captures with ground truth."""
    output_dir: Path
    """Folder for the bundles; finished fits in it are not repeated."""
    quality: tuple[str, ...] = ("draft", "standard")
    """Qualities of `splatart fit`."""


def main(options: Options) -> None:
    table = Table(*COLUMNS, box=SIMPLE_HEAD, pad_edge=False)
    for capture in options.captures:
        for quality in options.quality:
            bundle = options.output_dir / f"{capture.name}_{quality}"
            splatart("fit", capture, "--output-dir", bundle, "--quality", quality)
            splatart("eval", bundle, "--data", capture)
            metrics = json.loads((bundle / "metrics.json").read_text())
            report = json.loads((bundle / "report.json").read_text())
            table.add_row(capture.name, quality, f"{report['seconds']:.0f}", *figures(metrics))
    Console().print(table)


def figures(metrics: dict) -> list[str]:
    """The columns from "axis deg" on."""
    joints = metrics["joints"]
    right = sum(j["type_correct"] and j["parent_correct"] for j in joints)
    views = [v for name, v in metrics["images"].items() if name.startswith("state")]
    return [
        mean([j["axis_angle"] for j in joints]),
        mean([j["motion_geodesic"] for j in joints if j["type"] == "revolute"]),
        mean([j["displacement_percent"] for j in joints if j["type"] == "prismatic"]),
        f"{right} of {len(joints)}",
        mean([v["psnr"] for v in views]),
        mean([v["part_iou"] for v in views]),
    ]


def mean(values: list[float | None]) -> str:
    """Of the known values, to three digits."""
    known = [v for v in values if v is not None]
    return f"{math.fsum(known) / len(known):.3g}" if known else "-"


def splatart(*arguments: object) -> None:
    command = [sys.executable, "-c", "from splatart_ns.cli import main; main()", *map(str, arguments)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main(tyro.cli(Options))
