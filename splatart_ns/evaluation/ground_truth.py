"""What a capture's `ground_truth.json` and `ground_truth_points/` say. Read by evaluation alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from splatart_ns.capture.capture import Normalization
from splatart_ns.capture.values import check_inside
from splatart_ns.capture.view import load_points
from splatart_ns.records import Record, read_record

FORMAT = "articulated-ground-truth-1"
_TYPES = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"}


@dataclass(frozen=True)
class TrueJoint:
    """A joint; axis and origin are in the world at state 0."""

    name: str
    type: str
    """"revolute", "prismatic" or "fixed"."""
    parent: int | None
    """Label id; None for a part without geometry, which no image shows."""
    child: int | None
    parent_name: str
    child_name: str
    axis: Tensor
    """Unit axis [3] float64."""
    origin: Tensor
    """[3] float64."""
    values: Tensor
    """Change of the joint value since state 0 [S] float64, radian or length."""
    absolute_zero: float
    """The simulator's own value at state 0."""


@dataclass(frozen=True)
class NovelState:
    """A configuration that no fitting saw."""

    folder: str
    values: dict[str, float]
    """Change of each joint's value since state 0."""
    motions: dict[int, Tensor]
    """Motion of each part since state 0 [4, 4]."""


@dataclass(frozen=True)
class GroundTruth:
    """The truth about one capture; parts by label id, lengths in the capture's unit, float64."""

    parts: dict[int, str]
    """The parts that have geometry."""
    root: int
    """The root, or the first part with geometry where the root has none."""
    joints: list[TrueJoint]
    motions: dict[int, Tensor]
    """Motion of each part since state 0 [S, 4, 4], world frame."""
    novel: list[NovelState]
    points: dict[int, Tensor]
    """Surface points at state 0 [N, 3] of each part that has any."""
    radius: float
    """The object's bounding radius."""

    def relative_motion(self, joint: TrueJoint) -> Tensor:
        """The child's motion relative to its parent [S, 4, 4], canonical frame; both have geometry."""
        return torch.linalg.solve(self.motions[joint.parent], self.motions[joint.child])


def load_ground_truth(capture: Path) -> GroundTruth | None:
    """Read and check the truth beside a capture; None where there is no `ground_truth.json`."""
    path = Path(capture) / "ground_truth.json"
    if not path.is_file():
        return None
    top = read_record(check_inside(capture, path), "check the capture's folder")
    if (form := top.text("format")) != FORMAT:
        top.fail("format", f"is '{form}'", f"this version reads '{FORMAT}'")
    shaped = [record for record in top.records("parts") if record.flag("has_geometry")]
    parts = {record.integer("id"): record.text("name") for record in shaped}
    if not parts:
        top.fail("parts", "has none with geometry", "give the truth about something that can be seen")
    root = next((record for record in shaped if record.flag("root")), shaped[0]).integer("id")

    if top.record("cameras").number("object_bounding_radius") <= 0:
        top.record("cameras").fail("object_bounding_radius", "is not above 0", "give the object's radius")
    states = top.records("states")
    if not states:
        top.fail("states", "is empty", "give the truth of each state")
    motions = {
        part: torch.cat(
            [s.record("motion_from_state_0").motions(n, [s.record("motion_from_state_0").items(n)], 1) for s in states]
        )
        for part, n in parts.items()
    }
    joints = [_read_joint(record, len(states), parts) for record in top.records("joints")]
    points = {}
    for part in parts:
        file = check_inside(capture, Path(capture) / "ground_truth_points" / f"part_{part}.ply")
        points[part] = load_points(file, Normalization(torch.zeros(3).numpy(), 1.0))[0].double()
    return GroundTruth(
        parts=parts,
        root=root,
        joints=joints,
        motions=motions,
        novel=[_read_novel(record, joints, parts) for record in top.records("novel")],
        points=points,
        radius=top.record("cameras").number("object_bounding_radius"),
    )


def _read_joint(record: Record, num_states: int, parts: dict[int, str]) -> TrueJoint:
    kind = record.choice("type", list(_TYPES))
    ids = {}
    for key in ("parent_id", "child_id"):
        ids[key] = None if key in record.fields and record.fields[key] is None else record.integer(key)
        if ids[key] is not None and ids[key] not in parts:
            record.fail(key, f"is {ids[key]}", f"parts with geometry are {', '.join(map(str, parts))}")
    axis = record.tensor("axis", (3,))
    if abs(float(axis.norm()) - 1) > 1e-4:
        record.fail("axis", f"has the length {float(axis.norm()):g}", "give a unit vector")
    values = record.tensor("values", (num_states,))
    return TrueJoint(
        name=record.text("name"),
        type=_TYPES[kind],
        parent=ids["parent_id"],
        child=ids["child_id"],
        parent_name=record.text("parent"),
        child_name=record.text("child"),
        axis=axis / axis.norm(),
        origin=record.tensor("origin", (3,)),
        values=values - values[0],
        absolute_zero=float(values[0]),
    )


def _read_novel(record: Record, joints: list[TrueJoint], parts: dict[int, str]) -> NovelState:
    values, motions = record.record("joint_values"), record.record("motion_from_state_0")
    return NovelState(
        folder=record.text("folder"),
        values={joint.name: values.number(joint.name) - joint.absolute_zero for joint in joints},
        motions={part: motions.motions(name, [motions.items(name)], 1)[0] for part, name in parts.items()},
    )
