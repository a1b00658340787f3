"""Metrics as tables for a terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table
from rich.text import Text

_JOINT_COLUMNS = {
    "axis_angle": "axis angle\n(deg)",
    "axis_position": "axis position\n(0.1 length)",
    "pivot_offset": "pivot offset\n(length)",
    "motion_geodesic": "motion\n(deg | length)",
    "motion_value": "travel\n(deg | length)",
    "displacement": "displacement\n(length)",
    "displacement_percent": "displacement\n(% of radius)",
    "covered_95": "in 95 %\nregion",
}
_PART_COLUMNS = {"part_rotation": "rotation\n(deg)", "part_translation": "translation\n(length)"}
_IMAGE_COLUMNS = {
    "psnr": "PSNR\n(dB)",
    "ssim": "SSIM\n",
    "lpips": "LPIPS\n",
    "accumulation_l1": "accumulation\nL1",
    "part_iou": "part IoU\n",
}
_CHAMFER_COLUMNS = {"CD-s": "CD-s", "CD-m": "CD-m", "CD-w": "CD-w"}


def format_tables(metrics: dict[str, Any]) -> list[Table | Text]:
    """Everything in `metrics` for rich to print, one item after the other; tables without rows are left out."""
    joints = [
        (
            f"{j['parent']} - {j['child']}{'' if j['parent_correct'] else ' (wrong parent)'}",
            f"{j['type']}{'' if j['type_correct'] else ' (wrong type)'}",
            j,
        )
        for j in metrics["joints"]
    ]
    joints += [("mean", kind, values) for kind, values in metrics["joints_mean"].items() if any(_known(values))]
    tables = [
        _table("Joints", ["joint", "type"], _JOINT_COLUMNS, joints),
        _table("Part poses, relative to the root", ["part", "state"], _PART_COLUMNS, [
            (p["name"], p["state"], p) for p in metrics["parts"]
        ]),
        _table("Chamfer distance x 1000", ["of", "at"], _CHAMFER_COLUMNS, [
            row
            for name, values in metrics["geometry"].items()
            if values is not None
            for row in [(name, "state 0", values), (name, "last state", values["last"])]
        ]),
        _table("Images, test views", ["configuration"], _IMAGE_COLUMNS, list(metrics["images"].items())),
    ]  # fmt: skip
    lines = [f"{key}: {_shown(value)}" for key, value in metrics["structure"].items()]
    lines += [f"note: {note}" for note in metrics["notes"]]
    return [*(table for table in tables if table.row_count > 0), *(Text(line) for line in lines)]


def _known(values: dict[str, Any]) -> list[bool]:
    return [value is not None for value in values.values()]


def _table(title: str, names: list[str], columns: dict[str, str], rows: list[tuple]) -> Table:
    table = Table(title=title, title_justify="left")
    for name in names:
        table.add_column(name)
    for header in columns.values():
        table.add_column(header, justify="right")
    for *labels, values in rows:
        # As plain text: names may hold what rich takes for markup.
        table.add_row(*map(Text, labels), *(_shown(values[key]) for key in columns))
    return table


def _shown(value: Any) -> str:
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case _:
            return str(value)
