"""The commands that take a finished bundle: `splatart view`, `eval` and `export`."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, get_args

import tyro

from splatart_ns.choices import Format, Rasterizer
from splatart_ns.cli.common import CONSOLE, choose_rasterizer, device
from splatart_ns.errors import InputError


@dataclass
class View:
    """Open a bundle in the browser: move its joints, hide parts, play a sweep, save what you see."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """Folder that `splatart fit` left."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines in, who need no password."""
    port: int = 8080
    """Port of the page, 1 to 65535."""
    rasterizer: Rasterizer = "auto"
    """As in `splatart fit`."""

    def run(self) -> None:
        from splatart_ns.bundle import load
        from splatart_ns.viewer.viewer import Viewer

        if not 0 < self.port < 65536:
            raise InputError(f"--port is {self.port}; give 1 to 65535.")
        choose_rasterizer(self.rasterizer)
        viewer = Viewer(load(self.bundle), self.host, self.port)
        CONSOLE.print(f"Open http://{self.host}:{self.port} in a browser. Ctrl-C ends.")
        with contextlib.suppress(KeyboardInterrupt):
            viewer.run()


@dataclass
class Evaluate:
    """Compare a bundle with a capture's ground truth and test views; writes metrics.json into the bundle."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """Folder that `splatart fit` left."""
    data: Path
    """Folder of the capture."""
    rasterizer: Rasterizer = "auto"
    """As in `splatart fit`."""

    def run(self) -> None:
        choose_rasterizer(self.rasterizer)
        from splatart_ns.evaluation.evaluate import evaluate
        from splatart_ns.evaluation.tables import format_tables

        for table in format_tables(evaluate(self.bundle, self.data, device())):
            CONSOLE.print(table)


@dataclass
class Export:
    """Write a bundle for robot simulators, viewers and 3D programs, and open it there to check it; no GPU is needed."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """Folder that `splatart fit` left."""
    format: Annotated[tuple[tuple[Format, ...], ...], tyro.conf.UseAppendAction]
    """One or more: urdf, mjcf (MuJoCo), usd (UsdPhysics), glb (a node a part, animated), ply (all Gaussians), html (a
    page with a slider for each joint, in one file)."""
    output: Path | None = None
    """Folder of the export; with several formats each has its folder in it. By default BUNDLE/export/FORMAT."""
    scale: float | None = None
    """Metres per unit of the bundle; by default what its unit says, or 1 where it is unknown."""
    density: float = 400.0
    """Of the parts, filled, in kg / m^3."""
    limit_margin: float = 0.05
    """How much wider than a joint's range its limits are at both ends, as a share of the range."""
    validate: bool = True
    """Load what was written in the programs that read it and compare the poses of all links."""

    def run(self) -> None:
        from splatart_ns.bundle import export as exports
        from splatart_ns.bundle import load_bundle

        exports.check_numbers(self.scale, self.density, self.limit_margin)
        formats = tuple(dict.fromkeys(sum(self.format, ())))
        if not formats:
            raise InputError(f"--format names none; give one or more of {', '.join(get_args(Format))}.")
        defaults = {field.name: field.default for field in fields(self)}
        unused = {"scale": {"html"}, "density": {"html", "ply"}, "limit_margin": {"html", "ply"}}
        for option, nothing_to in unused.items():
            if getattr(self, option) != defaults[option] and set(formats) <= nothing_to:
                name = option.replace("_", "-")
                raise InputError(f"--{name} changes nothing of {' and '.join(formats)}; leave it out.")
        # What cannot be written is said before the meshes are made.
        exports.require(formats)
        folders = {form: self.bundle / "export" / form if self.output is None else self.output for form in formats}
        if self.output is not None and len(formats) > 1:
            folders = {form: self.output / form for form in formats}
        for folder in folders.values():
            exports.check_folder(folder)
        loaded = load_bundle(self.bundle)
        with CONSOLE.status(f"Meshes of {len(loaded.parts)} parts ..."):
            shapes = exports.part_shapes(loaded) if set(formats) - exports.WITHOUT_MESHES else None
        robot = exports.describe(
            loaded, shapes, self.bundle.resolve().name, self.scale, self.density, self.limit_margin
        )
        # A page has the bundle's own names, units and joints.
        for note in robot.notes if set(formats) - {"html"} else ():
            CONSOLE.print(f"note: {note}", markup=False)
        failed = False
        for form, folder in folders.items():
            path = exports.export(loaded, robot, form, folder)
            print(f"Export: {path}")
            for note in exports.format_notes(robot, form):
                CONSOLE.print(f"note: {note}", markup=False)
            if self.validate:
                checks = exports.validate(path, form, loaded, robot)
                failed |= any(check.verdict == "failed" for check in checks)
                CONSOLE.print(exports.format_checks(checks))
        if failed:
            raise SystemExit(1)
