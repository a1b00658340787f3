"""Captures that are hard to fit: what comes out, and whether the confidence is honest.

Usage:
    python benchmarks/hard_captures.py --output-dir /somewhere [--cases "drawer hidden at first" hinge]

Captures and bundles that are already in the output folder are kept: start it again to go on, remove what is to be
made anew. Every fit runs in a process of its own. `rows_<quality>.json` in the folder holds all figures.
"""

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from splatart_ns.bundle import load_bundle
from splatart_ns.bundle.bundle import Bundle
from splatart_ns.capture.articulated_object import ArticulatedObject, Joint, Link
from splatart_ns.capture.assembly import Assembly, Chain, Face, add_carcass, add_drawer, add_leaf, box
from splatart_ns.capture.capture import Capture
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.light import Light
from splatart_ns.capture.procedural import synthesize_object
from splatart_ns.capture.shapes import drum
from splatart_ns.capture.synthesis import synthesize
from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.capture.textures import Colour
from splatart_ns.evaluation.ground_truth import GroundTruth, TrueJoint, load_ground_truth
from splatart_ns.evaluation.joints import displacement, joint_errors, rotation_error
from splatart_ns.geometry.se3 import inverse

Palette = tuple[Colour, ...]
_GREY: Palette = ((70, 74, 82), (128, 134, 140), (226, 224, 216), (232, 112, 28))
_BLUE: Palette = ((32, 62, 120), (92, 148, 205), (218, 228, 236), (245, 190, 40))
_RED: Palette = ((128, 30, 34), (222, 96, 60), (246, 214, 168), (24, 44, 70))
_GREEN: Palette = ((24, 78, 58), (104, 168, 96), (226, 232, 190), (196, 42, 88))
_PLAIN: Palette = ((150, 150, 155),) * 4
_X, _Y, _Z = np.eye(3)

COLUMNS = {
    "case": "case",
    "tree": "tree",
    "types": "types\nright",
    "axis": "axis\ndeg",
    "line": "axis line\n0.1 R",
    "turn": "turn\ndeg",
    "displacement": "moved\n% R",
    "covered": "in\n95 %",
    "ambiguous": "ambi-\nguous",
    "sigma_turn": "turn's\ns.d. deg",
    "gaussians": "fewest\nGaussians",
    "seconds": "s",
}


@dataclass(frozen=True)
class Case:
    """A capture."""

    thing: str | Callable[[], ArticulatedObject]
    """What it shows: a built-in object or one of below."""
    states: tuple[str, ...] = ()
    """Joint values of the states; the object's own if not given."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """How it is rendered, besides the usual."""
    spoil: Callable[[Capture], None] | None = None
    """What is done to the files afterwards."""


def linked(name: str, grain: float, joints: Sequence[Joint], **links: tuple[Palette, list[trimesh.Trimesh]]):
    made = [Link(part, solids, palette, (7, k, 11)) for k, (part, (palette, solids)) in enumerate(links.items())]
    return ArticulatedObject(name, tuple(made), tuple(joints), grain)


def finished(name: str, assembly: Assembly, palettes: Mapping[str, Palette], grain: float = 0.05) -> ArticulatedObject:
    """An assembly with textures; parts of one look are alike to the last texel."""
    looks = sorted(set(assembly.looks.values()))
    links = tuple(
        Link(part, solids, palettes.get(assembly.looks[part], _BLUE), (7, looks.index(assembly.looks[part]), 3))
        for part, solids in assembly.solids.items()
    )
    return ArticulatedObject(name, links, tuple(assembly.joints), grain)


def closet(tight: bool = True, turntable: bool = False) -> ArticulatedObject:
    """A drawer behind a door: with the door shut, not a pixel of it is seen, or a few through the seam if not tight.

    On a turntable the drawer's parent is not the root.
    """
    assembly = Assembly("foot", box((-0.45, -0.35, -0.06), (0.1, 0.25, -0.03)), drum(0.1, -0.04, 0.0))
    if turntable:
        assembly.hang("body", "foot", "revolute", (0.0, 0.0, 0.02), _Z, (-2.0, 2.0))
    else:
        assembly = Assembly("body")
    add_carcass(assembly, "body", [-0.25, 0.25], [[0.0, 0.4]], 0.4, 0.03)
    front = Face("body", (0.0, -0.25, 0.0), _X, _Y)
    add_leaf(assembly, front, "door", 0.5, 0.4, 0.03, (0.0, 2.4))
    if tight:
        assembly.attach("door", front.box((-0.06, 0.0, 0.018), (0.0, 0.46, 0.382)))
    inner = Face("body", (-0.14, 0.0, 0.14), _X, _Y)
    add_drawer(assembly, inner, "drawer", (0.44, 0.22), 0.02, 0.25, "drawer")
    return finished("closet", assembly, {"foot": _GREY, "body": _GREEN, "door": _BLUE, "drawer": _RED})


def mast() -> ArticulatedObject:
    """A rod in a tube that turns on a foot: drawn in, only the end of the rod is seen. Its parent is not the root."""
    foot = [box((-0.2, -0.16, 0.0), (0.2, 0.16, 0.05)), box((-0.2, -0.16, 0.04), (-0.14, 0.0, 0.12))]
    tube = [box((-0.08, -0.08, -0.08), (0.0, 0.08, 0.08))]
    tube += [box((-0.08, s * 0.05, -0.08), (0.5, s * 0.08, 0.08)) for s in (-1, 1)]
    tube += [box((-0.08, -0.08, s * 0.05), (0.5, 0.08, s * 0.08)) for s in (-1, 1)]
    tube += [box((0.2, -0.03, 0.075), (0.35, 0.06, 0.12)), drum(0.06, -0.15, -0.07)]
    rod = [box((0.02, -0.046, -0.046), (0.495, 0.046, 0.046)), box((0.3, -0.02, -0.02), (0.499, 0.04, 0.048))]
    joints = (
        Joint("tube_joint", "revolute", "foot", "tube", (0.0, 0.0, 0.203), (0, 0, 1), (-2.0, 2.0)),
        Joint("rod_joint", "prismatic", "tube", "rod", (0.0, 0.0, 0.0), (1, 0, 0), (0.0, 0.45)),
    )
    return linked("mast", 0.05, joints, foot=(_GREEN, foot), tube=(_BLUE, tube), rod=(_RED, rod))


def drawers() -> ArticulatedObject:
    """Three drawers that are alike to the last texel."""
    assembly = Assembly("body")
    add_carcass(assembly, "body", [-0.22, 0.22], [[0.0, 0.2, 0.4, 0.6]], 0.4, 0.03)
    for k in range(3):
        face = Face("body", (0.0, 0.0, 0.1 + 0.2 * k), _X, _Y)
        add_drawer(assembly, face, f"drawer_{k + 1}", (0.44, 0.2), 0.03, 0.4, "drawer")
    return finished("drawers", assembly, {"body": _GREEN, "drawer": _RED})


def round_root() -> ArticulatedObject:
    """A chain of five hinges on a plain round foot."""
    assembly = Assembly("base", drum(0.14, 0.0, 0.05, chamfer=0.01), drum(0.07, 0.04, 0.1))
    chain = Chain(assembly, "base", np.eye(3), (0.0, 0.0, 0.17))
    rng = np.random.default_rng(0)
    for k in range(5):
        chain.pitch(f"link_{k + 1}", 0.07, 0.5 * math.pi * (k % 2), 0.0, 1 - 2 * (k % 2), (-1.5, 1.5))
        chain.reach(0.24, 0.07, rng)
    assembly.attach(chain.tip, box(chain.at - 0.06, chain.at + (0.05, 0.09, 0.05)))
    palettes = {"base": _PLAIN} | {f"link_{k + 1}": (_BLUE, _RED, _GREEN)[k % 3] for k in range(5)}
    return finished("round_root", assembly, palettes)


def wheel(palette: Palette, mark: bool, rim: bool) -> ArticulatedObject:
    """A disc on a stand: about its own axis, or about an axis near its rim; perhaps with a mark."""
    stand = [box((-0.15, -0.15, 0.0), (0.1, 0.15, 0.03)), box((-0.1, -0.04, 0.02), (-0.02, 0.04, 0.4))]
    offset = 0.17 if rim else 0.0
    disc = [drum(0.22, 0.01, 0.06, "x", at=(0.0, 0.0, offset)), drum(0.04, -0.018, 0.02, "x")]
    disc += [box((0.05, -0.03, 0.1), (0.09, 0.03, 0.18))] * mark
    joint = Joint("disc_joint", "revolute", "stand", "disc", (0.0, 0.0, 0.33), (1, 0, 0), (-3.2, 3.2))
    return linked("wheel", 0.05, [joint], stand=(_GREEN, stand), disc=(palette, disc))


def knob(sides: int) -> ArticulatedObject:
    """A plain prism of so many sides on a textured stand, which looks the same after a turn by 1 / sides."""
    stand = [box((-0.15, -0.25, 0.0), (0.1, 0.15, 0.03)), box((-0.1, -0.24, 0.02), (-0.02, 0.24, 0.6))]
    ring = 0.17 * np.array([(0.0, math.cos(a), math.sin(a)) for a in np.arange(sides) * 2 * math.pi / sides])
    prism = trimesh.convex.convex_hull(np.concatenate([ring + (0.01, 0.0, 0.0), ring + (0.09, 0.0, 0.0)]))
    joint = Joint("knob_joint", "revolute", "stand", "knob", (0.0, 0.0, 0.35), (1, 0, 0), (-3.2, 3.2))
    return linked("knob", 0.05, [joint], stand=(_GREEN, stand), knob=(_PLAIN, [prism, drum(0.04, -0.018, 0.02, "x")]))


def button() -> ArticulatedObject:
    """A panel with a sliding and a turning part of a few pixels."""
    panel = [box((-0.05, -0.4, 0.0), (0.0, 0.4, 0.5)), box((-0.2, -0.3, 0.0), (0.1, 0.3, 0.04))]
    slider = [box((0.002, -0.015, -0.025), (0.04, 0.015, 0.025))]
    lever = [box((0.002, -0.012, -0.012), (0.03, 0.012, 0.07))]
    joints = (
        Joint("slider_joint", "prismatic", "panel", "slider", (0.0, -0.2, 0.3), (0, 1, 0), (0.0, 0.3)),
        Joint("lever_joint", "revolute", "panel", "lever", (0.0, 0.25, 0.3), (1, 0, 0), (-2.0, 2.0)),
    )
    return linked("button", 0.05, joints, panel=(_GREEN, panel), slider=(_RED, slider), lever=(_BLUE, lever))


def flip_labels(capture: Capture, share: float = 0.1, reach: int = 2) -> None:
    """Give this share of the pixels within `reach` of a border between labels a label from across the border."""
    rng = np.random.default_rng(0)
    for state in capture.states:
        for frame in state.split("train"):
            if frame.labels is None:
                continue
            labels = read_labels(frame.labels)
            # What stands `reach` pixels away in a direction that is drawn anew for every pixel.
            rows, columns = np.indices(labels.shape)
            away = rng.integers(-reach, reach + 1, (2, *labels.shape))
            near = labels[
                np.clip(rows + away[0], 0, labels.shape[0] - 1), np.clip(columns + away[1], 0, labels.shape[1] - 1)
            ]
            kernel = np.ones((2 * reach + 1,) * 2, np.uint8)
            border = cv2.dilate(labels, kernel) != cv2.erode(labels, kernel)
            crossing = border & (near != labels)
            chance = share * border.sum() / max(1, crossing.sum())
            flipped = crossing & (rng.random(labels.shape) < chance)
            cv2.imwrite(str(frame.labels), np.where(flipped, near, labels).astype(np.uint8))


def flip_half(capture: Capture) -> None:
    flip_labels(capture, share=0.5, reach=3)


_HARD_LIGHT = {"light": Light(ambient=0.15)}
_FEW_LABELS = {"labelled_fraction": 0.25}
_SHUT = "door_joint=0,drawer_joint=0"
_OPEN = "door_joint=2,drawer_joint=0.06"
_OUT = "door_joint=2.3,drawer_joint=0.16"
_IN, _HALF, _DRAWN = (f"tube_joint={a},rod_joint={b}" for a, b in ((0, 0), (0.7, 0.2), (-0.6, 0.4)))
_BENT = tuple(
    ",".join(f"link_{k + 1}_joint={v}" for k, v in enumerate(values))
    for values in ((0.5, -0.4, 0.6, 0.3, -0.5), (-0.2, 0.4, -0.1, -0.5, 0.4))
)

CASES: dict[str, Case] = {
    "hinge": Case("hinge"),
    "drawer": Case("drawer"),
    "arm": Case("arm"),
    "hinge, 10 % of border labels wrong": Case("hinge", spoil=flip_labels),
    "drawer, 10 % of border labels wrong": Case("drawer", spoil=flip_labels),
    "arm, 10 % of border labels wrong": Case("arm", spoil=flip_labels),
    "arm, half of 3-pixel border wrong": Case("arm", spoil=flip_half),
    "hinge, 5 labelled frames": Case("hinge", settings=_FEW_LABELS),
    "drawer, 5 labelled frames": Case("drawer", settings=_FEW_LABELS),
    "arm, 5 labelled frames": Case("arm", settings=_FEW_LABELS),
    "hinge, hard light": Case("hinge", settings=_HARD_LIGHT),
    "arm, hard light": Case("arm", settings=_HARD_LIGHT),
    "round root, five hinges": Case(round_root, _BENT),
    "drawer never hidden": Case(closet, (_OPEN, _OUT, "door_joint=1.7,drawer_joint=0.11")),
    "drawer hidden at first": Case(closet, (_SHUT, _OPEN, _OUT)),
    "drawer hidden at last": Case(closet, (_OPEN, _OUT, _SHUT)),
    "drawer hidden at first of two": Case(closet, (_SHUT, _OUT)),
    "drawer nearly hidden at first": Case(lambda: closet(tight=False), (_SHUT, _OPEN, _OUT)),
    "turning drawer hidden at first": Case(
        lambda: closet(turntable=True),
        tuple(f"body_joint={a},{q}" for a, q in ((0.0, _SHUT), (0.6, _OPEN), (-0.5, _OUT))),
    ),
    "rod nearly hidden at first": Case(mast, (_IN, _HALF, _DRAWN)),
    "rod nearly hidden at last": Case(mast, (_HALF, _DRAWN, _IN)),
    "hinge, 90 degrees": Case("hinge", ("lid_joint=0.3", "lid_joint=1.8708")),
    "hinge, 132 degrees": Case("hinge", ("lid_joint=0", "lid_joint=2.3")),
    "arm, 120 degrees": Case("arm", ("yaw=-1.0,shoulder=0.1,elbow=1.5", "yaw=1.0944,shoulder=0.7,elbow=0.7")),
    "arm, 180 degrees": Case("arm", ("yaw=-1.5708,shoulder=0.1,elbow=1.5", "yaw=1.5708,shoulder=0.7,elbow=0.7")),
    "three drawers alike": Case(
        drawers,
        (
            "drawer_1_joint=0.02,drawer_2_joint=0.1,drawer_3_joint=0.25",
            "drawer_1_joint=0.2,drawer_2_joint=0.22,drawer_3_joint=0.05",
        ),
    ),
    "plain disc about its axis": Case(lambda: wheel(_PLAIN, False, False), ("disc_joint=0", "disc_joint=1.2")),
    "textured disc about its axis": Case(lambda: wheel(_BLUE, False, False), ("disc_joint=0", "disc_joint=1.2")),
    "disc with a mark": Case(lambda: wheel(_PLAIN, True, False), ("disc_joint=0", "disc_joint=1.2")),
    "plain disc about its rim": Case(lambda: wheel(_PLAIN, False, True), ("disc_joint=0", "disc_joint=1.2")),
    "plain square knob": Case(lambda: knob(4), ("knob_joint=0", "knob_joint=0.4")),
    "plain hexagonal knob": Case(lambda: knob(6), ("knob_joint=0", "knob_joint=0.3")),
    "plain square knob, 60 degrees": Case(lambda: knob(4), ("knob_joint=0", "knob_joint=1.0472")),
    "parts of a few pixels": Case(button, ("slider_joint=0.05,lever_joint=-0.6", "slider_joint=0.25,lever_joint=0.8")),
}


@dataclass
class Options:
    """What to make and fit."""

    output_dir: Path
    """Folder for captures and bundles; what is finished in it is not repeated."""
    cases: tuple[str, ...] = ()
    """All if not given."""
    resolution: int = 128
    """Pixels along each side of an image."""
    views: int = 20
    """Training views per state."""
    quality: str = "draft"
    """Of `splatart fit`."""


def main(options: Options) -> None:
    rows = []
    for name in options.cases or CASES:
        rows.append({"case": name, **measure(name, options)})
        path = options.output_dir / f"rows_{options.quality}.json"
        path.write_text(json.dumps(rows, indent=1) + "\n")
        print(f"{name}: {rows[-1].get('failed', 'done')}", file=sys.stderr, flush=True)
    table = Table(*COLUMNS.values(), box=SIMPLE_HEAD, pad_edge=False)
    for row in rows:
        table.add_row(*(text(row.get(key)) for key in COLUMNS))
    console = Console(width=150)
    console.print(table)
    for row in rows:
        for note in [row["failed"]] if "failed" in row else row["notes"]:
            console.print(f"{row['case']}: {note}", soft_wrap=True)


def measure(name: str, options: Options) -> dict[str, Any]:
    """The figures of a case, from its files once they are there."""
    slug = "".join(c if c.isalnum() else "_" for c in name)
    capture_path, bundle_path = (options.output_dir / kind / slug for kind in ("captures", "bundles"))
    if not (capture_path / "ground_truth.json").exists():
        make(CASES[name], capture_path, options)
    if not (bundle_path / "articulation.json").exists():
        command = [sys.executable, "-c", "from splatart_ns.cli import main; main()"]
        command += ["fit", str(capture_path), "--output-dir", str(bundle_path), "--quality", options.quality]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if done.returncode != 0:
            return {"failed": done.stderr.strip().splitlines()[-1]}
    report = json.loads((bundle_path / "report.json").read_text())
    truth, bundle = load_ground_truth(capture_path), load_bundle(bundle_path)
    notes = [note for stage in report["stages"] for note in stage["notes"]]
    return figures(truth, bundle, states_that_show(load_capture(capture_path))) | {
        "seconds": round(report["seconds"]),
        "notes": notes,
    }


def make(case: Case, path: Path, options: Options) -> None:
    settings = SynthesisOptions(
        train_views=options.views, test_views=2, resolution=options.resolution, joint_values=case.states
    )
    settings = replace(settings, **case.settings)
    if isinstance(case.thing, str):
        synthesize_object(case.thing, path, settings)
    else:
        with tempfile.TemporaryDirectory() as folder:
            synthesize(case.thing().write(Path(folder)), path, settings)
    if case.spoil is not None:
        case.spoil(load_capture(path))


def states_that_show(capture: Capture) -> dict[int, list[int]]:
    """For each part the states in which a label shows it."""
    shown: dict[int, list[int]] = {part: [] for part in capture.parts}
    for s, state in enumerate(capture.states):
        labels = [np.unique(read_labels(f.labels)) for f in state.frames if f.labels is not None]
        for part in set(np.concatenate(labels).tolist()) & set(shown):
            shown[part].append(s)
    return shown


def figures(truth: GroundTruth, bundle: Bundle, shown: Mapping[int, list[int]]) -> dict[str, Any]:
    """A row: the worst joint's errors. Motions are those between the states that show a part."""
    joints = [joint_errors(joint, truth, bundle)[0] for joint in truth.joints]
    motions = [motion_errors(joint, truth, bundle, shown) for joint in truth.joints]
    turns = [turn_sigma(bundle, truth, joint, shown) for joint in truth.joints]
    children = {part.id: part for part in bundle.parts}

    def worst(values: Sequence[float | None]) -> float | None:
        return max((v for v in values if v is not None), default=None)

    return {
        "tree": all(j["parent_correct"] for j in joints),
        "types": f"{sum(bool(j['type_correct']) for j in joints)} of {len(joints)}",
        "axis": worst([j["axis_angle"] for j in joints]),
        "line": worst([None if j["axis_position"] is None else j["axis_position"] / truth.radius for j in joints]),
        "turn": worst([m[0] for m in motions]),
        "displacement": worst([m[1] for m in motions]),
        "covered": f"{sum(j['covered_95'] is True for j in joints)} of {len(joints)}",
        "ambiguous": sum(j.ambiguous for j in bundle.joints if j.in_tree),
        "sigma_turn": worst(turns),
        "gaussians": min(len(part.splat) for part in children.values()),
        "joints": joints,
    }


def motion_errors(
    joint: TrueJoint, truth: GroundTruth, bundle: Bundle, shown: Mapping[int, list[int]]
) -> tuple[float | None, float | None]:
    """Degrees and share of the radius in percent by which a child's motion against its parent is wrong."""
    states = [s for s in shown[joint.child] if s in shown[joint.parent]]
    if len(states) < 2:
        return None, None
    T = {part.id: part.motion for part in bundle.parts}

    def since_first(parent: torch.Tensor, child: torch.Tensor) -> torch.Tensor:
        relative = inverse(parent) @ child
        return relative[states] @ inverse(relative[states[0]])

    found = since_first(T[joint.parent], T[joint.child])[1:]
    true = since_first(truth.motions[joint.parent], truth.motions[joint.child])[1:]
    # Both in the parent's frame at state 0, where the child's true points stood at the first state that shows it.
    first = states[0]
    at_first = inverse(truth.motions[joint.parent][first]) @ truth.motions[joint.child][first]
    points = truth.points[joint.child] @ at_first[:3, :3].mT + at_first[:3, 3]
    degrees = float(rotation_error(found[:, :3, :3], true[:, :3, :3]).max())
    return degrees, 100 * displacement(points, found, true) / truth.radius


def turn_sigma(bundle: Bundle, truth: GroundTruth, joint: TrueJoint, shown: Mapping[int, list[int]]) -> float | None:
    """The largest reported standard deviation of a child's turn, degrees, at the states that show it."""
    part = next(p for p in bundle.parts if p.id == joint.child)
    C = part.motion_covariance[shown[joint.child]][:, 3:, 3:]
    if not torch.isfinite(C).all():
        return None
    return math.degrees(math.sqrt(float(torch.linalg.eigvalsh(C).max().clamp_min(0))))


def text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main(tyro.cli(Options))
