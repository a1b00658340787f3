"""report.json: which stages of a fit have finished, by what, and what they took."""

from __future__ import annotations

import platform
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from splatart_ns.bundle.folder import ARTICULATION, remove_bundle
from splatart_ns.capture.capture import Capture
from splatart_ns.capture.digest import IDENTITY, capture_identity, is_another
from splatart_ns.errors import InputError
from splatart_ns.files import write_json
from splatart_ns.machine import num_cores
from splatart_ns.plugin.companion import Outcome
from splatart_ns.plugin.settings import Settings
from splatart_ns.rasterize.rasterization import default_backend, default_device
from splatart_ns.shape import NUMBER, has_shape, parse

_REPORT = {"stages": [{"name": str, "seconds": NUMBER}], "settings": dict, "versions": dict}
_IMAGES = [{"state": str, "psnr": NUMBER}]
TRAINED_ON = ("device", "rasterizer")
"""What the report says of the machine that trained; the one that finds the joints may be another, without a GPU."""


def report_head(capture: Capture, settings: Settings) -> dict[str, Any]:
    """What was fitted, how, and by what."""
    return {
        **capture_identity(capture),
        "settings": asdict(settings.of(capture)),
        "seed": settings.seed,
        "device": "cuda: " + torch.cuda.get_device_name() if default_device() == "cuda" else "cpu",
        "rasterizer": default_backend(),
        "threads": num_cores(),
        "versions": {"python": platform.python_version()}
        | {name: version(name) for name in ("splatart-ns", "nerfstudio", "torch", "gsplat", "numpy")},
    }


class Report:
    """report.json: which stages have finished, and what they took. Written before and after each stage.

    A stage's `seconds` are its own, its `wall_seconds` what it added to the whole: less for states fitted side by side.
    """

    def __init__(self, path: Path, capture: Capture, settings: Settings):
        self.path = path
        self.data = report_head(capture, settings) | {"stages": [], "seconds": 0.0}
        self._here = {key: self.data[key] for key in TRAINED_ON}
        self._earlier = self._read_stages() if path.exists() else []
        self._last = time.perf_counter()

    def _read_stages(self) -> list[dict[str, Any]]:
        """What an earlier run has finished, when it was of the same capture, settings and version."""
        earlier = parse(self.path.read_bytes() if self.path.is_file() else None, _REPORT) or {"stages": None}
        # Versions before had seconds alone.
        stages = [{"wall_seconds": entry["seconds"], **entry} for entry in earlier["stages"] or ()]
        if earlier["stages"] is None or not has_shape(stages, [{"wall_seconds": NUMBER}]):
            raise InputError(
                f"{self.path} is not a report of `splatart fit`; remove it or choose another --output-dir."
            )
        if is_another(earlier, self.data):
            raise InputError(
                f"{self.path.parent} holds a fit of {earlier['capture']}; choose another --output-dir, or remove it."
            )
        had, wanted = earlier["settings"], self.data["settings"]
        same = all(earlier.get(key) == self.data[key] for key in IDENTITY)
        last = ("root", "joints") if wanted["worlds"] == "shared" else ("joints",)  # the last stage alone asks
        same = same and {k: v for k, v in had.items() if k not in last} == {
            k: v for k, v in wanted.items() if k not in last
        }
        if any(had.get(k) != wanted[k] for k in last):
            stages = [stage for stage in stages if stage["name"] != "joint"]
        version_had, version_here = (of["versions"].get("splatart-ns") for of in (earlier, self.data))
        if same and version_had == version_here:
            self.data |= {key: earlier[key] for key in TRAINED_ON if key in earlier}
            return stages
        other = f"by splatart-ns {version_had}" if same else "of other images or with other settings"
        CONSOLE.print(f"{self.path.parent} holds a fit {other}; starting over.", markup=False)
        return []

    def resume(self, stage: str, whole: bool) -> bool:
        """Whether a stage needs no work: it and all before it were finished, and its files are still `whole`."""
        if whole and self._earlier and self._earlier[0]["name"] == stage:
            self.data["stages"].append(self._earlier.pop(0))
            self._last = time.perf_counter()
            return True
        self._earlier.clear()
        # Before the stage's files change, lest a killed run leaves them with another run's results and report.
        _remove_results(self.path)
        self._write()
        return False

    def add(self, stage: str, outcome: Outcome) -> None:
        """Note a finished stage."""
        now = time.perf_counter()
        self.data |= self._here if stage != "joint" else {}
        self.data["stages"].append({"name": stage, "wall_seconds": round(now - self._last, 2), **outcome})
        self._last = now
        self._write()

    @property
    def summary(self) -> str:
        """Error and time of a finished fit."""
        images = next((stage.get("images") for stage in self.data["stages"] if stage["name"] == "pose"), None)
        told = f"{self._seconds():.0f} s"
        if has_shape(images, _IMAGES):  # of an earlier run there may be none
            shown = ", ".join(f"{of['state']} {of['psnr']:.1f}" for of in images)
            told = f"PSNR of training images: {shown} dB; {told}"
        return told

    def _seconds(self) -> float:
        return sum(stage["wall_seconds"] for stage in self.data["stages"])

    def _write(self) -> None:
        self.data["seconds"] = round(self._seconds(), 2)
        write_json(self.path, self.data)


def _remove_results(report: Path) -> None:
    """Remove the bundle beside a report, where there is one or the other, and what was made of it."""
    bundle = report.parent
    if not report.exists() and not (bundle / ARTICULATION).exists():
        return  # whatever lies there is no fit's
    remove_bundle(bundle)
    if (bundle / "export").is_dir():
        from splatart_ns.bundle.export.folder import remove_exports  # which loads the libraries of all formats

        remove_exports(bundle / "export")
