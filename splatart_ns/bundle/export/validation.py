"""Exports opened in the programs that they are for, and compared with the bundle."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from rich import box
from rich.table import Table
from rich.text import Text

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.export.consumers import (
    GlbAnimation,
    GlbModel,
    MujocoModel,
    PybulletModel,
    UsdModel,
    YourdfpyModel,
)
from splatart_ns.bundle.export.describe import expected_poses
from splatart_ns.bundle.export.glb import sweep
from splatart_ns.bundle.export.page_model import PageModel
from splatart_ns.bundle.export.robot import Robot
from splatart_ns.bundle.export.simulation import simulate
from splatart_ns.bundle.posing import configured_motions
from splatart_ns.bundle.sliders import bundle_sliders, configuration
from splatart_ns.choices import Format

CONFIGURATIONS = 100
POSE_ERROR = 1e-6
"""The most that a link's pose may differ: rotation matrices as they are, positions in the robot's sizes."""
_EXCESS, _REACHED = 0.01, 0.9
_PACKED_ERROR = 1e-3
"""The most that a Gaussian in a page may be off, in radii of the object."""
_CONSUMERS = {
    "urdf": (("yourdfpy", YourdfpyModel), ("mujoco", MujocoModel), ("pybullet", PybulletModel)),
    "mjcf": (("mujoco", MujocoModel),),
    "usd": (("usd-core", UsdModel),),
    "glb": (("trimesh", GlbModel),),
    "ply": (),
    "html": (),
}
"""By format, the packages that read it."""


@dataclass(frozen=True)
class Check:
    """One line of the report."""

    program: str
    what: str
    verdict: Literal["passed", "failed", "not checked", "note"]
    found: str


def validate(path: Path, form: Format, bundle: Bundle, robot: Robot) -> list[Check]:
    """Open an export in every program at hand and compare it with the bundle."""
    if form == "ply":
        return _guarded("trimesh", "Gaussians", lambda: _check_ply(path, bundle, robot))
    if form == "html":
        return _guarded("splatart", "page", lambda: _check_page(path, bundle))
    wanted = [(values, expected_poses(bundle, robot, values)) for values in random_values(robot, CONFIGURATIONS)]
    checks = []
    for program, model in _CONSUMERS[form]:
        checks += _guarded(
            program, "link poses", lambda p=program, m=model: [_check_poses(p, m(path, robot), wanted, robot)]
        )
    if form == "mjcf":
        checks += _guarded("mujoco", "10 s under gravity", lambda: _check_simulation(path, robot))
    if form == "glb":
        checks += _guarded("trimesh", "animation", lambda: _check_animation(path, bundle, robot))
    return [*checks, _self_collision(robot)]


def _guarded(program: str, what: str, check: Callable[[], list[Check]]) -> list[Check]:
    """What a check finds; failed if the program raises or warns, not checked if it is not installed."""
    try:
        with _warnings() as heard:
            checks = check()
    except ImportError:
        return [Check(program, what, "not checked", f"pip install {program}")]
    except Exception as error:  # whatever a program says of a file that it does not take
        return [Check(program, what, "failed", f"{type(error).__name__}: {error}")]
    return checks + [Check(program, "warnings", "failed", text) for text in dict.fromkeys(heard)]


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """What is warned of, by `warnings` and by logging, in the block."""
    heard: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: heard.append(record.getMessage())
    logging.getLogger().addHandler(handler)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            yield heard
    finally:
        logging.getLogger().removeHandler(handler)
    heard += [str(w.message) for w in caught if issubclass(w.category, UserWarning)]


def random_values(robot: Robot, count: int) -> list[dict[str, float]]:
    """Values of all freedoms, evenly distributed between the limits; the same every time."""
    rng = np.random.default_rng(0)
    return [robot.complete({f.name: rng.uniform(*f.limits) for f in robot.freedoms}) for _ in range(count)]


def _check_poses(program: str, model: Any, wanted: list[tuple[dict, dict]], robot: Robot) -> Check:
    """`wanted` are values of the freedoms and the poses expected there."""
    pairs = [(model.poses(values), expected) for values, expected in wanted]
    return _poses_check(program, "link poses", pairs, robot.size)


def _poses_check(program: str, what: str, pairs: list[tuple[dict, dict]], size: float) -> Check:
    """Compares (found, expected) poses, positions in sizes of the object; NaN fails."""
    worst, where = -1.0, ""
    for found, expected in pairs:
        for name in expected:
            difference = np.abs(found[name] - expected[name])
            difference[:3, 3] /= size
            error = float(np.nan_to_num(difference, nan=np.inf).max())
            if error > worst:
                worst, where = error, name
    verdict = "passed" if worst <= POSE_ERROR else "failed"
    return Check(program, what, verdict, f"error {worst:.0e} at most of {len(pairs)} ('{where}')")


def _check_simulation(path: Path, robot: Robot) -> list[Check]:
    run = simulate(path)
    what = f"{run.seconds:g} s under gravity"
    if not run.stable:
        return [Check("mujoco", what, "failed", "values are not finite, or it exploded")]
    found = f"beyond limits by {run.excess:.1%} of the range"
    if run.slowest:
        found += f"; moved across {run.reached:.0%} of it ('{run.slowest}')"
    strayed = run.strayed / robot.size
    if strayed:
        found += f"; what follows others strayed by {strayed:.1%} of the object's size"
    if run.touched:
        found += f"; touched: {_pairs(run.touched)}"
    verdict = "passed" if max(run.excess, strayed) <= _EXCESS else "failed"
    if run.reached < _REACHED:
        # What loops allow of a joint's range is not known.
        verdict = "note" if robot.loops and verdict == "passed" else "failed"
    if verdict == "note":
        loops = ", ".join(f"'{loop.name}'" for loop in robot.loops)
        found += f"; the loops hold it ({loops}): look at their axes, or take them out of the file's <equality>"
    checks = [Check("mujoco", what, verdict, found)]
    if run.at_rest:
        checks.append(Check("mujoco", "contacts at rest", "failed", _pairs(run.at_rest)))
    return checks


def _pairs(pairs: Iterable[tuple[str, str]]) -> str:
    return ", ".join(f"'{a}' and '{b}'" for a, b in sorted(pairs))


def _check_animation(path: Path, bundle: Bundle, robot: Robot) -> list[Check]:
    animation = GlbAnimation(path, robot)
    times, configurations = sweep(robot)
    pairs = []
    for t in np.random.default_rng(0).uniform(0, times[-1], CONFIGURATIONS):
        q = {name: np.interp(t, times, [values[name] for values in configurations]) for name in configurations[0]}
        pairs.append((animation.poses(t), expected_poses(bundle, robot, q)))
    return [_poses_check("trimesh", "animation", pairs, robot.size)]


def _check_ply(path: Path, bundle: Bundle, robot: Robot) -> list[Check]:
    """By a reader that is not ours."""
    vertices = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    found = np.stack([vertices["x"], vertices["y"], vertices["z"]], axis=1)
    ids, means = [], []
    for part in bundle.parts:
        ids += [part.id] * len(part.splat)
        means.append(part.splat.means.double().numpy() * robot.scale)
    same = np.array_equal(vertices["part"], ids)
    error = np.abs(found - np.concatenate(means)).max(initial=0.0) / robot.size if same else np.inf
    verdict = "passed" if error <= POSE_ERROR else "failed"
    what = f"{len(found)} of {len(ids)}, in {len(bundle.parts)} parts; error {error:.0e} at most"
    return [Check("trimesh", "Gaussians", verdict, what)]


def _check_page(path: Path, bundle: Bundle) -> list[Check]:
    """Its data, read again; what it does with them is only known to a browser."""
    page, rng, sliders = PageModel(path), np.random.default_rng(0), bundle_sliders(bundle)
    counts = {part.name: len(part.splat) for part in bundle.parts}
    found = {part["name"]: part["count"] for part in page.object["parts"]}
    error = np.inf
    if found == counts:
        differences = [page.column(i, "means") - part.splat.means.numpy() for i, part in enumerate(bundle.parts)]
        error = np.abs(np.concatenate(differences)).max(initial=0.0) / page.radius
    what = f"{sum(found.values())} of {sum(counts.values())}, in {len(counts)} parts; error {error:.0e} at most"
    checks = [Check("splatart", "Gaussians", "passed" if error <= _PACKED_ERROR else "failed", what)]
    pairs = []
    for _ in range(CONFIGURATIONS):
        q = configuration(sliders, [rng.uniform(slider.low, slider.high) for slider in sliders])
        pairs.append((page.motions(q), {name: T.numpy() for name, T in configured_motions(bundle, q).items()}))
    return [*checks, _poses_check("splatart", "part poses", pairs, page.radius)]


def _self_collision(robot: Robot) -> Check:
    pairs = [f"'{a}' and '{b}' by {depth:.2g} m" for (a, b), depth in robot.overlaps.items()]
    found = f"{', '.join(pairs)}: not collided" if pairs else "none but neighbours"
    return Check("splatart", "overlap at rest", "note", found)


def format_checks(checks: list[Check]) -> Table:
    """For a person to read."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for column in ("program", "check", "verdict", "found"):
        table.add_column(column, overflow="fold")
    colours = {"passed": "green", "failed": "red", "not checked": "yellow", "note": "default"}
    for check in checks:
        verdict = Text(check.verdict, colours[check.verdict])
        table.add_row(Text(check.program), Text(check.what), verdict, Text(check.found))
    return table
