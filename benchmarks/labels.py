"""How a fit depends on its labels: their number, noise along their outlines, frames whose labels are wrong.

Usage:
    python benchmarks/labels.py CAPTURE [CAPTURE ...] --output-dir /somewhere [--labelled 2 5 10 40] [--quality draft]

Of each capture with ground truth, copies keep the labels of so many training frames a state, spread evenly over their
order. In the noisy copies every outline wanders by up to a pixel, and in 2 % of the labelled frames of each state, one
at least, two parts change places; `splatart check` is asked which. Copies and finished fits are kept.
"""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
from fit_table import COLUMNS, figures, splatart
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from splatart_ns.capture.images import read_labels, write_png

WRONG = 0.02
"""Share of the labelled frames that are wrong."""


@dataclass
class Options:
    """What to fit."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of captures with ground truth, states in folders, all frames labelled."""
    output_dir: Path
    """Folder for the copies and the bundles."""
    labelled: tuple[int, ...] = (2, 5, 10, 40)
    """Labelled training frames of each state."""
    noisy: tuple[int, ...] = (5, 40)
    """The same for copies with noise and wrong frames."""
    quality: str = "draft"
    """Of `splatart fit`."""


def main(options: Options) -> None:
    table = Table("capture", "labelled", "wrong", "named", "s", *COLUMNS, box=SIMPLE_HEAD, pad_edge=False)
    for source in options.captures:
        for count, noisy in [(n, False) for n in options.labelled] + [(n, True) for n in options.noisy]:
            name = f"{source.name}_{count}" + "_noisy" * noisy
            capture, bundle = options.output_dir / name, options.output_dir / f"{name}_{options.quality}"
            if not (capture / "wrong.json").exists():
                write_copy(source, capture, count, noisy)
            wrong = json.loads((capture / "wrong.json").read_text())
            named, others = named_by_check(capture, wrong) if noisy else (0, 0)
            splatart("fit", capture, "--output-dir", bundle, "--quality", options.quality)
            splatart("eval", bundle, "--data", capture)
            metrics, report = (json.loads((bundle / f"{file}.json").read_text()) for file in ("metrics", "report"))
            verdict = f"{named}, and {others} others" if noisy else ""
            table.add_row(
                source.name, str(count), f"{len(wrong)}", verdict, f"{report['seconds']:.0f}", *figures(metrics)
            )
            Console().print(table)


def write_copy(source: Path, target: Path, count: int, noisy: bool) -> None:
    """The capture with `count` labelled training frames a state; `wrong.json` lists label files that are wrong."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, copy_function=os.link)
    for folder in target.rglob("*/"):
        folder.chmod(0o755)
    wrong = []
    for k, file in enumerate(sorted(target.glob("state_*/transforms.json"))):
        rng = np.random.default_rng([count, k])
        meta = json.loads(file.read_text())
        train = [entry for entry in meta["frames"] if entry["file_path"] in meta["train_filenames"]]
        kept = [train[i] for i in np.linspace(0, len(train) - 1, count).round().astype(int)]
        swapped = rng.permutation(count)[: max(1, round(WRONG * count))] if noisy else []
        for entry in train:
            if not any(entry is other for other in kept):
                entry.pop("semantics_path", None)
        for i, entry in enumerate(kept if noisy else []):
            path = file.parent / entry["semantics_path"]
            labels = wandering(read_labels(path), rng)
            if i in swapped:
                labels = exchanged(labels)
                wrong.append(str(path.relative_to(target)))
            path.unlink()  # a hard link: the source keeps its file
            write_png(path, labels)
        file.unlink()
        file.write_text(json.dumps(meta))
    (target / "wrong.json").write_text(json.dumps(wrong))


def wandering(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The labels with outlines that wander by up to a pixel, in waves of some 8 pixels, as a person's hand does."""
    height, width = labels.shape
    coarse = rng.normal(size=(2, height // 8 + 1, width // 8 + 1)).astype(np.float32)
    shift = [np.clip(cv2.resize(c, (width, height), interpolation=cv2.INTER_CUBIC), -1, 1) for c in coarse]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return cv2.remap(labels, x + shift[0], y + shift[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def exchanged(labels: np.ndarray) -> np.ndarray:
    """The labels with the two largest parts' ids exchanged."""
    a, b = np.argsort(np.bincount(labels.ravel(), minlength=255)[1:255])[-2:] + 1
    return np.where(labels == a, b, np.where(labels == b, a, labels)).astype(np.uint8)


def named_by_check(capture: Path, wrong: list[str]) -> tuple[int, int]:
    """How many of the wrong label files `splatart check` names, and how many others."""
    command = [sys.executable, "-c", "from splatart_ns.cli import main; main()", "check", str(capture), "--json"]
    found = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)
    files = {p["file"] for p in found["problems"] if "/semantics/" in p["file"]}
    expected = {str(capture / path) for path in wrong}
    return len(files & expected), len(files - expected)


if __name__ == "__main__":
    main(tyro.cli(Options))
