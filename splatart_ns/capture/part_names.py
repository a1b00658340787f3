"""The names of a capture's parts."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from splatart_ns.capture.capture import UNLABELLED, CaptureError, Frame, Problem, Report
from splatart_ns.capture.images import MAX_LABEL, read_labels
from splatart_ns.capture.values import show
from splatart_ns.machine import num_cores


def read_part_names(
    metas: Sequence[tuple[Path, dict[str, Any]]], frames: Sequence[Frame], report: Report
) -> dict[int, str]:
    """Part id to name, from the `semantic_classes` of transforms.json files (path and content), else `part_1`,
    `part_2`, ... up to the largest id in the frames' labels. What cannot be read is reported and left out, and so is
    told what is called otherwise than `semantic_classes` says."""
    named: tuple[Path, list[str]] | None = None
    for file, meta in metas:
        try:
            classes = _classes(file, meta)
        except CaptureError as error:
            report(error.problem)
            continue
        if classes is not None and named is not None and classes != named[1]:
            mend = f"use the list of {named[0]} in all states"
            report(Problem("error", file, "semantic_classes differs from another state's", mend))
        elif classes is not None:
            named = named or (file, classes)
    if named is not None:
        file, given = named
        safe = safe_names(given)
        if changed := [f"{show(old)} is called {new}" for old, new in zip(given, safe, strict=True) if old != new]:
            called = ", ".join(changed[:3]) + (", ..." if len(changed) > 3 else "")
            mend = "use that name, or write others of A-Z, a-z, 0-9, _, . and - into semantic_classes"
            report(Problem("warning", file, f"part names are made fit for files: {called}", mend))
        return dict(enumerate(safe, start=1))
    return {i: f"part_{i}" for i in range(1, _largest_label(frames, report) + 1)}


def _classes(file: Path, meta: dict[str, Any]) -> list[str] | None:
    classes = meta.get("semantic_classes")
    if classes is None:
        return None
    if not isinstance(classes, list) or not classes or not all(isinstance(c, str) for c in classes):
        raise CaptureError(
            file, f"semantic_classes is {show(classes)}", 'write a list of names, "background" first, then the parts'
        )
    if classes[0].lower() not in ("background", "bg"):
        raise CaptureError(
            file, f"semantic_classes begins with {show(classes[0])}", 'put "background" first: it is the label 0'
        )
    if len(classes) - 1 > MAX_LABEL:
        raise CaptureError(file, f"semantic_classes has {len(classes) - 1} parts", f"name at most {MAX_LABEL}")
    return classes[1:]


def safe_names(names: Sequence[str]) -> list[str]:
    """Names that can be file names everywhere: of [A-Za-z0-9_.-], and unique even where case does not count. Those that
    can be keep theirs, so that no name becomes what another one is."""
    bases = [_safe(name) or f"part_{i + 1}" for i, name in enumerate(names)]
    out: dict[int, str] = {}
    taken: set[str] = set()
    for i in sorted(range(len(names)), key=lambda i: bases[i] != names[i]):
        safe, n = bases[i], 1
        while safe.lower() in taken:
            n += 1
            safe = f"{bases[i]}_{n}"
        taken.add(safe.lower())
        out[i] = safe
    return [out[i] for i in range(len(names))]


def in_ascii(name: str) -> str:
    """Without accents, and without letters that are not Latin."""
    return unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()


def _safe(name: str) -> str:
    """Without accents, and `_` for what else is not allowed between letters; may be empty."""
    if re.fullmatch(r"[A-Za-z0-9_.-]*", name) is None:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", in_ascii(name)).strip("_")
    return name[:64].lstrip(".-").rstrip(".")


def _largest_label(frames: Sequence[Frame], report: Report) -> int:
    def largest(path: Path) -> int | Problem:
        try:
            labels = read_labels(path)
        except CaptureError as error:
            return error.problem
        return int(labels[labels != UNLABELLED].max(initial=0))

    with ThreadPoolExecutor(num_cores()) as pool:
        found = list(pool.map(largest, [f.labels for f in frames if f.labels is not None]))
    for problem in found:
        if isinstance(problem, Problem):
            report(problem)
    return max((label for label in found if isinstance(label, int)), default=0)
