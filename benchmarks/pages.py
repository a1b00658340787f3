"""Tables and pictures of generated documents."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def save(figure: Figure, path: Path) -> None:
    """As a PNG of 64 colours: plots need no more, and the repository keeps every version."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90, format="png")
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.open(buffer).convert("RGB").quantize(64).save(path, optimize=True)
