import math
from dataclasses import replace

import pytest
import torch

from splatart_ns.bundle import configured_motions, load_bundle, observed_values, save_bundle
from splatart_ns.bundle.assemble import assemble_bundle
from splatart_ns.bundle.configurations import movable_joints, sweep
from splatart_ns.splats import Splat
from splatart_ns.stages.articulate import Joint, KinematicTree
from splatart_ns.stages.joint_fit import JointFit

NAMES = {1: "body", 2: "door", 3: "knob", 4: "cat"}
Z, X = torch.tensor([0.0, 0, 1]).double(), torch.tensor([1.0, 0, 0]).double()


def fit(kind: str, axis: torch.Tensor, value: float) -> JointFit:
    return JointFit(kind, axis, torch.zeros(3).double(), 0.0, torch.tensor([0.0, value]).double(), residual=1e-3)


def assemble(bundle, names=NAMES):
    tree = KinematicTree(
        [1, 2, 3, 4],
        root=1,
        joints=[
            Joint(1, 2, fit("revolute", Z, 0.5)),
            Joint(2, 3, fit("prismatic", X, 0.2), other=Joint(1, 3, replace(fit("revolute", Z, 0.2), score=7.0))),
        ],
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
        tree, {p: splat for p in names}, motions, {p: zeros for p in names}, names, ["a", "b"], "metre", {"seed": 0}
    )


@pytest.fixture
def assembled(bundle):
    return assemble(bundle)


def test_parts_on_the_tree_move_as_their_joints_say(assembled):
    door, knob = assembled.part("door").motion[1], assembled.part("knob").motion[1]
    assert math.atan2(door[1, 0], door[0, 0]) == pytest.approx(0.5)
    assert torch.allclose(knob[:3, 3], door[:3, :3] @ (0.2 * X))


def test_a_part_that_hangs_on_nothing_keeps_its_own_motion(assembled):
    assert assembled.part("cat").motion[1, 0, 3] == 7.0


def test_a_part_that_may_hang_on_another_has_an_ambiguous_joint_and_names_it(assembled):
    door, knob = assembled.tree_joints
    assert not door.ambiguous and door.alternatives == []
    assert knob.ambiguous
    assert knob.alternatives == [{"type": "revolute", "residual": 1e-3, "score": 7.0, "parent": "body"}]


def test_loops_name_the_parts_around_them(assembled):
    (loop,) = assembled.loops
    assert loop == {"joint": "body_to_knob", "parts": ["knob", "door", "body"]}
    assert [j.name for j in assembled.joints if not j.in_tree] == ["body_to_knob"]


def test_joints_whose_parts_names_read_alike_have_names_of_their_own(bundle, tmp_path):
    told = assemble(bundle, {1: "a", 2: "b_to_c", 3: "a_to_b_to_c", 4: "c"})
    assert [joint.name for joint in told.joints] == ["a_to_b_to_c_joint", "b_to_c_to_a_to_b_to_c", "a_to_a_to_b_to_c"]
    told = assemble(bundle, {1: "a", 2: "a_to_b", 3: "b_to_a_to_b", 4: "c"})
    names = [joint.name for joint in told.joints]
    assert len(set(names)) == 3 and told.loops[0]["joint"] == names[2]
    save_bundle(told, tmp_path)
    assert [j.name for j in load_bundle(tmp_path).joints] == names


def test_what_is_assembled_is_a_valid_bundle(assembled, tmp_path):
    save_bundle(assembled, tmp_path)
    assert [j.name for j in load_bundle(tmp_path).tree_joints] == ["body_to_door", "door_to_knob"]
    assert isinstance(assembled.parts[0].splat, Splat)


def test_no_joint_has_the_name_of_a_part(bundle, tmp_path):
    save_bundle(assemble(bundle, NAMES | {3: "body_to_door"}), tmp_path)
    assert [j.name for j in load_bundle(tmp_path).tree_joints] == ["body_to_door_joint", "door_to_body_to_door"]


def test_joints_of_more_freedom_are_saved_loaded_and_posed(bundle, tmp_path):
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    joints = []
    for part, (kind, dofs) in enumerate({"cylindrical": 2, "spherical": 3, "free": 6}.items(), start=2):
        values = torch.cat([torch.zeros(1, dofs).double(), random(3, dofs)])
        covariance = {"values": torch.eye(4 * dofs).double().tolist()}
        joints.append(Joint(1, part, JointFit(kind, Z, random(3), 0.0, values, 1e-3, covariance=covariance)))
    tree = KinematicTree([1, 2, 3, 4], 1, joints)
    eye = torch.eye(4).double().repeat(4, 1, 1)
    motions = {1: eye} | {j.child: j.fit.motion(j.fit.values) for j in joints}
    zeros = {p: torch.zeros(4, 6, 6).double() for p in NAMES}
    splats = dict.fromkeys(NAMES, bundle.parts[0].splat)
    save_bundle(assemble_bundle(tree, splats, motions, zeros, NAMES, list("abcd"), "metre", {}), tmp_path)
    loaded = load_bundle(tmp_path)
    for state in range(4):
        posed = configured_motions(loaded, observed_values(loaded, state))
        for part, name in NAMES.items():
            assert torch.allclose(posed[name], motions[part][state])
    assert len(movable_joints(loaded)) == 3
    frames = sweep(loaded, {}, 4)
    assert len(frames) == 12
    assert all(set(configured_motions(loaded, q)) == set(NAMES.values()) for q in frames)
