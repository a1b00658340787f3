"""Metrics as tables for a terminal."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

# Narrow enough for a terminal of 80 columns; metrics.json has all figures.
_JOINT_COLUMNS = {
    "axis_angle": "axis\ndeg",
    "axis_position": "axis pos\n0.1 len",
    "pivot_offset": "pivot\nlength",
    "motion_geodesic": "motion\ndeg|len",
    "motion_value": "travel\ndeg|len",
    "displacement_percent": "ADD\n% radius",
    "covered_95": "in\n95 %",
}
_PART_COLUMNS = {"part_rotation": "rotation\ndeg", "part_translation": "translation\nlength"}
_IMAGE_COLUMNS = {
    "psnr": "PSNR\ndB",
    "ssim": "SSIM\n",
    "lpips": "LPIPS\n",
    "accumulation_l1": "accumulation\nL1",
    "part_iou": "part IoU\n",
}
_HELD_OUT_COLUMNS = {
    "residual": "residual\n",
    "fitted_residual": "residual of\nfitted states",
    "psnr": "PSNR\ndB",
    "part_iou": "part IoU\n",
}
_CHAMFER_COLUMNS = {"CD-s": "CD-s", "CD-m": "CD-m", "CD-w": "CD-w"}
_PARENTS = {True: "", False: " (wrong parent)", None: " (not comparable)"}
"""What is said of a joint by its `parent_correct`."""


def format_tables(metrics: dict[str, Any]) -> list[Table | Text]:
    """Everything in `metrics` for rich to print, one item after the other; tables without rows are left out."""
    joints = [
        (
            f"{j['child']}{_PARENTS[j['parent_correct']]}",
            f"{j['type']}{' (wrong)' if j['type_correct'] is False else ''}",
            j,
        )
        for j in metrics["joints"]
    ]
    joints += [("mean", kind, values) for kind, values in metrics["joints_mean"].items() if any(_known(values))]
    tables = [
        _table("Joints, by the part that moves", ["joint", "type"], _JOINT_COLUMNS, joints),
        _table("Part poses, relative to the root", ["part", "state"], _PART_COLUMNS, [
            (p["name"], p["state"], p) for p in metrics["parts"]
        ]),
        _table("Chamfer distance x 1000", ["of", "at"], _CHAMFER_COLUMNS, [
            row
            for name, values in metrics["geometry"].items()
            if values is not None
            for row in [(name, "state 0", values), (name, "last state", values["last"])]
        ]),
        _table("Images, test views", ["configuration"], _IMAGE_COLUMNS, _views(metrics["images"])),
        _table("Held-out configurations, values found in images", ["configuration"], _HELD_OUT_COLUMNS, _views(
            metrics["held_out"]
        )),
    ]  # fmt: skip
    lines = [f"{key}: {_shown(value)}" for key, value in metrics["structure"].items()]
    lines += [f"note: {note}" for note in metrics["notes"]]
    return [*(table for table in tables if table.row_count > 0), *(Text(line) for line in lines)]


def _views(scores: dict[str, dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    """Rows, which say where figures mean something else: colours within the rendered silhouette."""
    return [
        (f"{name} (rendered silhouette)" if values.get("silhouette") == "rendered" else name, values)
        for name, values in scores.items()
    ]


def _known(values: dict[str, Any]) -> list[bool]:
    return [value is not None for value in values.values()]


def _table(title: str, names: list[str], columns: dict[str, str], rows: list[tuple]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for k, name in enumerate(names):
        table.add_column(name, overflow="fold", no_wrap=k > 0)
    for header in columns.values():
        table.add_column(header, justify="right", no_wrap=True)  # a figure cut short says something else
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
            return f"{value:.3g}"
        case _:
            return str(value)
