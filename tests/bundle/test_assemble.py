import math

import pytest
import torch

from splatart_ns.bundle import load_bundle, save_bundle
from splatart_ns.bundle.assemble import assemble_bundle
from splatart_ns.splats import Splat
from splatart_ns.stages.articulate import Joint, KinematicTree
from splatart_ns.stages.joint import JointFit

NAMES = {1: "body", 2: "door", 3: "knob", 4: "cat"}
Z, X = torch.tensor([0.0, 0, 1]).double(), torch.tensor([1.0, 0, 0]).double()


def fit(kind: str, axis: torch.Tensor, value: float) -> JointFit:
    return JointFit(kind, axis, torch.zeros(3).double(), 0.0, torch.tensor([0.0, value]).double(), residual=1e-3)


@pytest.fixture
def assembled(bundle):
    tree = KinematicTree(
        [1, 2, 3, 4],
        root=1,
        joints=[Joint(1, 2, fit("revolute", Z, 0.5)), Joint(2, 3, fit("prismatic", X, 0.2))],
        loops=[Joint(1, 3, fit("revolute", Z, 0.1))],
        unattached={4: "No joint explains how part 4 moves."},
    )
    splat = bundle.parts[0].splat
    eye = torch.eye(4).double().repeat(2, 1, 1)
    far = eye.clone()
    far[1, 0, 3] = 7.0
    motions = {1: eye, 2: far, 3: far, 4: far}
    zeros = torch.zeros(2, 6, 6).double()
    return assemble_bundle(
        tree, {p: splat for p in NAMES}, motions, {p: zeros for p in NAMES}, NAMES, ["a", "b"], "metre", {"seed": 0}
    )


def test_parts_on_the_tree_move_as_their_joints_say(assembled):
    door, knob = assembled.part("door").motion[1], assembled.part("knob").motion[1]
    assert math.atan2(door[1, 0], door[0, 0]) == pytest.approx(0.5)
    assert torch.allclose(knob[:3, 3], door[:3, :3] @ (0.2 * X))


def test_a_part_that_hangs_on_nothing_keeps_its_own_motion(assembled):
    assert assembled.part("cat").motion[1, 0, 3] == 7.0


def test_loops_name_the_parts_around_them(assembled):
    (loop,) = assembled.loops
    assert loop == {"joint": "body_to_knob", "parts": ["knob", "door", "body"]}
    assert [j.name for j in assembled.joints if not j.in_tree] == ["body_to_knob"]


def test_what_is_assembled_is_a_valid_bundle(assembled, tmp_path):
    save_bundle(assembled, tmp_path)
    assert [j.name for j in load_bundle(tmp_path).tree_joints] == ["body_to_door", "door_to_knob"]
    assert isinstance(assembled.parts[0].splat, Splat)
