"""`splatart fit`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatart_ns.choices import Quality, Rasterizer, RefineCameras, Worlds
from splatart_ns.cli.common import choose_rasterizer


@dataclass
class Fit:
    """Fit an articulated splat to a capture: all stages, resumed after the last finished one."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    output_dir: Path
    """Folder of the bundle; created, or continued when it holds a fit of this capture. One with other settings, or of
    other images in its place, is replaced; when a stage runs again, the bundle, its metrics.json and its exports go
    first. A fit of another capture stays."""
    quality: Quality = "standard"
    """draft is fast, high is slow."""
    root: str | None = None
    """Name of the part that the others hang on; chosen when not given."""
    seed: int = 0
    """Seed of everything random."""
    joint: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What you know of a joint, by the parts' names: child:parent, child:parent=revolute (or another type),
    child:parent=none (there is none) or child:parent=not-revolute."""
    worlds: Worlds | None = None
    """For states that were captured separately: rigid where the device measured lengths, similar where structure from
    motion gave each its own scale. The states are brought into the world of the first by the part --root, or one that
    is chosen. By default what the capture says."""
    refine_cameras: RefineCameras = "auto"
    """Whether to correct the cameras' poses; auto does where the silhouettes contradict each other; where images have
    none it always tries, and keeps what moves the images by 0.7 pixels or more."""
    downscale: int | None = None
    """How many times smaller than they are to look at images: 1 at all their pixels. By default so that no more than
    800 are left along the longer side, with --quality high 1600; a draft takes half of these, if that leaves 128."""
    rasterizer: Rasterizer = "auto"
    """auto takes gsplat on CUDA, else numba where it is installed, else torch."""

    def run(self) -> None:
        from splatart_ns.plugin.companion import Companions
        from splatart_ns.plugin.imports import few_imports

        with Companions() as companions:
            if not (self.output_dir / "report.json").exists():  # else the states may be there already
                companions.start_early()
            with few_imports():
                from splatart_ns.plugin.fit import fit

            choose_rasterizer(self.rasterizer)
            how = (self.quality, self.root, self.seed, self.rasterizer, self.joint, self.worlds, self.refine_cameras)
            fit(self.capture, self.output_dir, *how, self.downscale, companions)
