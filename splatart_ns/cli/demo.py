"""`splatart demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatart_ns.capture.synthesis_options import OBJECTS, SynthesisOptions
from splatart_ns.choices import Quality
from splatart_ns.cli.bundle import Evaluate
from splatart_ns.cli.common import CONSOLE
from splatart_ns.cli.fit import Fit
from splatart_ns.cli.render import Render
from splatart_ns.errors import InputError


@dataclass
class Demo:
    """Make a capture of a built-in object, fit it, compare it with the truth and render a sweep. No download."""

    output_dir: Path = Path("demo")
    """Folder for the capture, the bundle and the film."""
    object: Literal[OBJECTS] = "hinge"
    """The built-in object."""
    quality: Quality = "standard"
    """Of the fit."""

    def run(self) -> None:
        from splatart_ns.capture.procedural import synthesize_object
        from splatart_ns.capture.values import read_json

        capture, bundle = self.output_dir / "capture", self.output_dir / "bundle"
        if (truth := capture / "ground_truth.json").is_file():
            source = read_json(truth).get("source")
            made_of = source.get("robot_name") if isinstance(source, dict) else None
            if made_of != self.object:
                raise InputError(f"{capture}: shows no {self.object}; give another --output-dir, or remove it.")
        else:
            options = SynthesisOptions(train_views=30, resolution=192)
            CONSOLE.print(f"Rendering a capture of the built-in {self.object} ...")
            synthesize_object(self.object, capture, options)
        Fit(capture, bundle, self.quality).run()
        Evaluate(bundle, capture).run()
        film = self.output_dir / "sweep.gif"
        Render(bundle, film, sweep=True, frames=40, fps=20, resolution=256, azimuth=-50).run()
        print(f"Look at {film}; the bundle is {bundle}")
