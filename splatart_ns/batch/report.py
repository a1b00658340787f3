"""What became of every object: report.csv and report.html."""

from __future__ import annotations

import csv
import io
import json
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from splatart_ns.batch.entry import Entry
from splatart_ns.batch.page import write_page
from splatart_ns.batch.storage import Storage

COLUMNS = (
    "name",
    "status",
    "stage",
    "reason",
    "parts",
    "states",
    "joints",
    "movable",
    "unattached",
    "residual_worst",
    "axis_deviation_worst_deg",
    "ambiguous",
    "failed_checks",
    "gaussians",
    "seconds",
    "stage_seconds",
    "capture",
)


class Report:
    """Rows of objects in the order of the entries. They lie in a file: a million of them are no burden to memory."""

    def __init__(self, entries: Sequence[Entry]):
        self._entries = entries
        self._file = tempfile.TemporaryFile()
        self._places: dict[int, int] = {}
        self.counts: Counter[str] = Counter()
        """Number of objects by status."""

    def add(self, index: int, row: dict[str, Any]) -> None:
        self._places[index] = self._file.seek(0, io.SEEK_END)
        self._file.write(json.dumps(row).encode() + b"\n")
        self.counts[row["status"]] += 1

    def rows(self) -> Iterator[dict[str, Any]]:
        """Of all objects; those that no row was added of are "unfinished"."""
        for index, entry in enumerate(self._entries):
            if index in self._places:
                self._file.seek(self._places[index])
                yield json.loads(self._file.readline())
            else:
                yield {"name": entry.name, "capture": entry.capture, "status": "unfinished", "seconds": 0.0}

    def write(self, out: Storage) -> None:
        """report.csv and report.html."""
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, restval="", extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(_flat, self.rows()))
        out.write("report.csv", text.getvalue().encode(errors="backslashreplace"))
        named = {"encoding": "utf-8", "errors": "backslashreplace", "suffix": ".html"}  # paths need not be Unicode
        with tempfile.NamedTemporaryFile("w", **named) as page:
            write_page(page, self.rows(), dict(self.counts), len(self._entries))
            page.flush()
            out.put(Path(page.name), "report.html")


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """A row as a CSV has it."""
    flat = dict(row)
    flat["stage_seconds"] = "; ".join(f"{name}: {seconds:g}" for name, seconds in row.get("stages", {}).items())
    if row["status"] != "done":
        return flat
    joints = row["joints"]
    deviations = [joint["axis_deviation"] for joint in joints if joint["axis_deviation"] is not None]
    return flat | {
        "parts": " ".join(row["parts"]),
        "joints": "; ".join(f"{joint['child']}:{joint['parent']}={joint['type']}" for joint in joints),
        "residual_worst": max((joint["residual"] for joint in joints), default=""),
        "axis_deviation_worst_deg": max(deviations, default=""),
        "ambiguous": sum(joint["ambiguous"] for joint in joints),
        "failed_checks": "; ".join(row["failed_checks"]),
    }
