"""Fits by the real command, and the columns that tell of each in a table."""

import math
import subprocess
import sys

COLUMNS = ("axis\ndeg", "turn\ndeg", "slide\n% R", "right", "PSNR\ndB", "part\nIoU")


def figures(metrics: dict) -> list[str]:
    """A bundle's metrics.json in these columns: means over the joints; "right" have the right type and parent."""
    joints = metrics["joints"]
    right = sum(bool(j["type_correct"] and j["parent_correct"]) for j in joints)
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
