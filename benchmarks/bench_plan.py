"""What `bench.py` fits: settings on captures, and the growth of the cost."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from pathlib import Path

from drawers_urdf import write_drawers

PRESETS = {"draft": 1.0, "standard": 2.5, "high": 9.0}
"""Qualities, and about how many times the draft's seconds they take."""
SLOW = 1.6
"""Of pose descent and of another rasterizer, the same."""
SLOW_GROUPS = "poses", "joints", "rasterizer", "labelled frames"
"""What takes one and a half to five times as long as the other settings."""


@dataclass(frozen=True)
class Scene:
    """A capture that is made, or one that is there."""

    name: str
    source: str
    """What `splatart synth` renders: random-SEED-PARTS, or drawers-PARTS; or the path of a capture."""
    flags: tuple[str, ...] = ()
    """Of `splatart synth`."""

    @property
    def made(self) -> bool:
        return self.source.startswith(("random-", "drawers-"))

    def synth_source(self, folder: Path) -> str:
        """What to give to `splatart synth`."""
        if not self.source.startswith("drawers-"):
            return self.source
        urdf = folder / f"{self.source}.urdf"
        write_drawers(urdf, int(self.source.split("-")[1]))
        return str(urdf)


@dataclass(frozen=True)
class Point:
    """One fit."""

    group: str
    """What is varied."""
    label: str
    """To what."""
    scene: Scene
    seed: int = 0
    quality: str = "draft"
    rasterizer: str = "auto"
    settings: tuple[str, ...] = ()
    """Of fit_with.py."""
    truth: Scene | None = None
    """What the errors are taken from, if not `scene`."""
    size: float | None = None
    """Of a growth's point: how many."""
    weight: float = field(default=1.0, compare=False)
    """About how many times a draft's seconds it takes."""

    @property
    def key(self) -> str:
        """The same for the same fit, in this run and in the next."""
        what = (self.group, self.label, self.scene.name, f"seed {self.seed}", self.quality, self.rasterizer)
        return " | ".join((*what, *self.settings))

    @property
    def of_growth(self) -> bool:
        return self.size is not None


@dataclass(frozen=True)
class Extent:
    """How much a run does."""

    parts: tuple[int, ...]
    """Of the random objects, one each."""
    seeds: int
    resolution: int
    views: int
    base: str
    """The preset whose settings are varied one by one."""
    factors: tuple[float, ...]
    """Of the base's Gaussians and steps."""
    sh_degrees: tuple[int, ...]
    """Beside the default, 1."""
    image_parts: tuple[int, ...]
    """Images of 1 / n of the pixels a side."""
    labelled: tuple[float, ...]
    """Shares of the views with labels."""
    slow_everywhere: bool
    """Whether `high` and the groups of `SLOW_GROUPS` run on every object, or on the first alone."""
    growths: dict[str, tuple[int, ...]]


QUICK = Extent(
    parts=(2, 4),
    seeds=1,
    resolution=128,
    views=12,
    base="draft",
    factors=(0.5, 2.0),
    sh_degrees=(0, 2),
    image_parts=(2,),
    labelled=(0.1,),
    slow_everywhere=False,
    growths={"Gaussians": (5000, 40000), "pixels a side": (128, 512), "parts": (2, 8), "states": (2, 5)},
)
FULL = Extent(
    parts=(2, 3, 5),
    seeds=2,
    resolution=256,
    views=40,
    base="standard",
    factors=(0.25, 0.5, 2.0),
    sh_degrees=(0, 2, 3),
    image_parts=(2, 4),
    labelled=(0.1, 0.3),
    slow_everywhere=True,
    growths={
        "Gaussians": (5000, 10000, 20000, 40000, 80000),
        "pixels a side": (128, 256, 512, 1024),
        "parts": (2, 4, 8, 15, 30),
        "states": (2, 3, 5, 10),
    },
)


def trade_offs(extent: Extent, given: list[Path]) -> list[Point]:
    """Settings on scenes and seeds: every scene and seed in turn, its settings in an order of its own."""
    synth = ("--resolution", str(extent.resolution), "--train-views", str(extent.views), "--test-views", "4")
    scenes = [Scene(f"object {p}", f"random-{100 + p}-{p}", synth) for p in extent.parts]
    scenes += [Scene(path.name, str(path)) for path in given]
    points = []
    for seed in range(extent.seeds):
        for scene in scenes:
            turn = settings_on(scene, seed, extent)
            if scene is not scenes[0] and not extent.slow_everywhere:
                turn = [point for point in turn if point.quality != "high" and point.group not in SLOW_GROUPS]
            random.Random(f"{seed} {scene.name}").shuffle(turn)
            points += turn
    return points


def settings_on(scene: Scene, seed: int, extent: Extent) -> list[Point]:
    """All settings on one scene."""
    base, cost = extent.base, PRESETS[extent.base]

    def point(group: str, label: str, *settings: str, weight: float = 1.0, **others) -> Point:
        others = {"scene": scene, "seed": seed, "quality": base} | others
        return Point(group, label, settings=settings, weight=cost * weight, **others)

    points = [Point("preset", q, scene, seed, q, weight=w) for q, w in PRESETS.items()]
    for factor in extent.factors:
        text = f"x {factor:g}"
        points.append(point("Gaussians", text, f"effort.gaussians=*{factor}", weight=max(1, 0.5 * factor)))
        points.append(
            point("iterations", text, *(f"effort.{n}=*{factor}" for n in ("steps", "merge_steps")), weight=factor)
        )
    for degree in extent.sh_degrees:
        points.append(point("SH degree", str(degree), f"semantic.pipeline.model.sh_degree={degree}"))
    steps = "pose.pipeline.model.pose_steps=200"
    rungs = {
        "registration, then descent": (steps,),
        "centroids, then descent": (steps, "pose.pipeline.init=centroids"),
        "descent with Gaussians along": (
            steps,
            "pose.pipeline.init=centroids",
            "pose.pipeline.model.learn_gaussians=along",
        ),
    }
    points += [point("poses", label, *settings, weight=SLOW) for label, settings in rungs.items()]
    points.append(point("joints", "gradient descent", "joint.pipeline.method=descent", weight=4))
    points.append(point("rasterizer", "torch", rasterizer="torch", weight=SLOW))
    if scene.made:  # else there is no way to see the same object with fewer pixels or labels
        for part in extent.image_parts:
            pixels = extent.resolution // part
            smaller = Scene(f"{scene.name}, {pixels} px", scene.source, replaced(scene.flags, "--resolution", pixels))
            points.append(point("image scale", f"1 / {part}", scene=smaller, truth=scene, weight=1 / part))
        for fraction in extent.labelled:
            flags = (*scene.flags, "--labelled-fraction", str(fraction))
            fewer = Scene(f"{scene.name}, labels {fraction}", scene.source, flags)
            points.append(point("labelled frames", f"{fraction:.0%}", scene=fewer, truth=scene))
    return points


def replaced(flags: tuple[str, ...], flag: str, value: object) -> tuple[str, ...]:
    """With another value of one flag."""
    at = flags.index(flag) + 1
    return (*flags[:at], str(value), *flags[at + 1 :])


def growths(extent: Extent, seeds: int) -> list[Point]:
    """One size after the other, from few steps: seconds matter, errors do not."""
    short = ("effort.steps=100", "effort.merge_steps=50", "effort.longest=2048")
    few = ("--train-views", "8", "--test-views", "1", "--resolution")
    points = []
    for seed in range(seeds):
        for what, sizes in extent.growths.items():
            for size in sizes:
                source, flags, gaussians = "random-102-2", (*few, "128"), 4000
                if what == "Gaussians":
                    # Fewer pixels would not have as many Gaussians.
                    flags, gaussians = (*few, "1024"), size
                elif what == "pixels a side":
                    flags = (*few, str(size))
                elif what == "parts":
                    source, flags = f"drawers-{size}", (*few, "256")
                else:
                    flags = (*flags, "--states", str(size))
                scene = Scene(f"{source} {' '.join(flags)}", source, flags)
                settings = (*short, f"effort.gaussians={gaussians}")
                weight = 0.5 + size / sizes[-1] * {"parts": 4, "states": 3}.get(what, 2)
                points.append(Point(what, str(size), scene, seed, settings=settings, size=size, weight=weight))
    random.Random(0).shuffle(points)
    return points
