"""`splatart fit` with settings that its command line does not have, then the errors; one process a fit.

Usage:
    python benchmarks/fit_with.py CAPTURE --output-dir OUT --set effort.gaussians=2000 joint.pipeline.method=descent

`effort` is what the quality stands for; `semantic`, `pose` and `joint` are the stages' configurations. Seconds, with
those of the imports, are written to OUT/seconds.json.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import time
from pathlib import Path
from typing import Annotated, Any

import tyro
from sampling_profiler import SamplingProfiler

from splatart_ns.plugin.companion import Companions
from splatart_ns.plugin.imports import few_imports


@dataclasses.dataclass
class Options:
    """A fit."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    output_dir: Path
    """Folder of the bundle."""
    truth: Path | None = None
    """Capture to take the errors from, if another: the same object with more pixels or labels."""
    quality: str = "standard"
    """As of `splatart fit`."""
    seed: int = 0
    """As of `splatart fit`."""
    rasterizer: str = "auto"
    """As of `splatart fit`."""
    set: tuple[str, ...] = ()
    """Settings, path=value or path=*factor."""
    profile: bool = False
    """Whether to write where the seconds went to OUT/profile.json; one core, so that all is in this process."""
    score: bool = True
    """Whether to take the errors: OUT/metrics.json."""


def main(options: Options) -> None:
    start = time.perf_counter()
    if options.profile:
        os.environ["OMP_NUM_THREADS"] = "1"
    profiler = SamplingProfiler()
    with profiler if options.profile else contextlib.nullcontext(), Companions() as companions:
        companions.start_early()  # and what follows as `splatart fit` does it
        with few_imports():
            from splatart_ns.plugin import fit as fitting

        apply(options.set, options.quality)
        imported = time.perf_counter()
        how = {"seed": options.seed, "rasterizer": options.rasterizer, "companions": companions}
        fitting.fit(options.capture, options.output_dir, options.quality, **how)
    seconds = {"imports": imported - start, "all": time.perf_counter() - start}
    (options.output_dir / "seconds.json").write_text(json.dumps(seconds))
    if options.profile:
        (options.output_dir / "profile.json").write_text(json.dumps(profiler.seconds))
    if options.score:
        from splatart_ns.evaluation import evaluate

        # Meshes take longer than a draft, and say nothing that the motions and images do not.
        evaluate(options.output_dir, options.truth or options.capture, meshes=False)


def apply(settings: tuple[str, ...], quality: str) -> None:
    """Change what the stages of this process are configured with.

    Raises:
        SystemExit: A setting that is not there, or a value of another type.
    """
    from splatart_ns.plugin import settings as efforts
    from splatart_ns.plugin import stage_configs

    stages = {stage: getattr(stage_configs, f"{stage}_method").config for stage in ("semantic", "pose", "joint")}
    for setting in settings:
        path, _, text = setting.partition("=")
        first, *names = path.split(".")
        if first == "effort":
            effort = efforts.EFFORTS[quality]
            value = parse(text, getattr(effort, names[0], None), setting)
            efforts.EFFORTS[quality] = dataclasses.replace(effort, **{names[0]: value})
            continue
        owner = stages.get(first)
        for name in names[:-1]:
            owner = getattr(owner, name, None)
        setattr(owner, names[-1], parse(text, getattr(owner, names[-1], None), setting))


def parse(text: str, present: Any, setting: str) -> Any:
    """A value of the type of the present one; "*0.5" is half of it."""
    if present is None:
        raise SystemExit(f"{setting}: there is no such setting")
    if text.startswith("*"):
        return type(present)(present * float(text[1:]))
    if isinstance(present, bool):
        return {"true": True, "false": False}[text.lower()]
    return type(present)(text)


if __name__ == "__main__":
    main(tyro.cli(Options))
