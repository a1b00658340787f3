"""What several commands share."""

from __future__ import annotations

import os

from rich.console import Console

from splatart_ns.choices import Rasterizer

CONSOLE = Console(markup=False)  # paths and names may have brackets
if not CONSOLE.is_terminal and "COLUMNS" not in os.environ:
    CONSOLE.width = 160  # files and pipes have no edge at which tables and sentences must break


def choose_rasterizer(rasterizer: Rasterizer) -> None:
    """Rasterize with this backend from now on."""
    import torch

    from splatart_ns.rasterize.rasterization import default_backend, set_backend

    set_backend(rasterizer)
    if default_backend() == "torch" and device() == "cpu":
        torch.set_num_threads(1)  # its operations are so small that waking a second thread takes longer


def device() -> str:
    """The torch device to work on."""
    from splatart_ns.rasterize.rasterization import default_device

    return default_device()
