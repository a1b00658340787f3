"""What is written is read by other programs, and every link is where the bundle says."""

import dataclasses
import gc
import json
import logging
import re
import sys
import warnings
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from splatart_ns.bundle import JOINT_DOFS
from splatart_ns.bundle.export import PartShape, describe, export, validate, validation
from splatart_ns.bundle.export.names import identifier
from splatart_ns.bundle.export.simulation import simulate

FORMATS = ["urdf", "mjcf", "usd", "glb", "ply"]
NEEDS = {"mjcf": "mujoco", "usd": "pxr"}


@pytest.fixture(params=FORMATS)
def form(request):
    if request.param in NEEDS:
        pytest.importorskip(NEEDS[request.param], reason=f"{NEEDS[request.param]} is not installed: extra 'sim'")
    return request.param


def report(checks):
    return {(c.program, c.what): (c.verdict, c.found) for c in checks}


def assert_good(checks):
    assert checks and not [c for c in checks if c.verdict == "failed"], report(checks)


def test_every_joint_type_in_one_chain_and_branches(objects, tmp_path, form):
    bundle = objects.chain([kind for kind in JOINT_DOFS if kind != "free"])
    for i, (kind, parent) in enumerate([("free", "p0"), ("revolute", "p2"), ("prismatic", "p2")], start=7):
        bundle.parts.append(objects.make_bundle([f"p{k}" for k in range(i + 1)], []).parts[i])
        bundle.joints.append(objects.joint(f"j{i}", kind, parent, f"p{i}", i))
    robot = objects.robot(bundle, scale=0.5)
    assert_good(validate(export(bundle, robot, form, tmp_path / "out"), form, bundle, robot))


def test_names_of_people(objects, tmp_path, form):
    names = ["base/plate", "base plate", "Türe <1>", "2", "joints", "柜", "world"]
    joints = [
        objects.joint(f"{a} → {b}", "revolute", a, b, i + 1)
        for i, (a, b) in enumerate(zip(names, names[1:], strict=False))
    ]
    bundle = objects.make_bundle(names, joints)
    robot = describe(bundle, objects.shapes(bundle), "my thing (1)")
    path = export(bundle, robot, form, tmp_path / "ä folder")
    assert path.stem == identifier("my thing (1)")
    assert_good([c for c in validate(path, form, bundle, robot) if "gravity" not in c.what])


def test_tiny_flat_and_empty_parts(objects, tmp_path, form):
    import trimesh

    bundle = objects.chain(["revolute", "prismatic", "revolute", "fixed"])
    shapes = objects.shapes(bundle)
    speck = trimesh.creation.box([1e-4] * 3).apply_translation([0.7, 0.2, 0.1])
    foil = trimesh.creation.box([0.3, 0.3, 1e-5]).apply_translation([1.4, 0.4, 0.2])
    shapes |= {"p1": PartShape(speck, (speck,)), "p2": PartShape(foil, (foil,)), "p3": PartShape(None, ())}
    robot = describe(bundle, shapes, "thing")
    assert_good(validate(export(bundle, robot, form, tmp_path / "out"), form, bundle, robot))


def test_one_part_alone(objects, tmp_path, form):
    bundle = objects.make_bundle(["stone"], [])
    robot = objects.robot(bundle)
    assert_good(validate(export(bundle, robot, form, tmp_path / "out"), form, bundle, robot))


@pytest.mark.parametrize("form", ["urdf", "mjcf", "usd", "glb"])
def test_loops_are_written_or_noted(objects, tmp_path, form):
    if form in NEEDS:
        pytest.importorskip(NEEDS[form])
    bundle = objects.chain(["revolute", "revolute"])
    bundle.joints += [objects.joint(f"{kind} closure", kind, "p2", "p0", 1, in_tree=False) for kind in JOINT_DOFS]
    robot = objects.robot(bundle)
    path = export(bundle, robot, form, tmp_path / "out")
    notes = " ".join(json.loads((path.parent / "export.json").read_text())["notes"])
    left_out = {k for k in JOINT_DOFS if re.search(rf"Joint '{k}_closure' closes a loop[^:]*: left out", notes)}
    assert ("'screw_closure' closes a loop and is a screw" in notes) == (form == "usd")
    if form == "usd":
        stage = pytest.importorskip("pxr.Usd").Stage.Open(str(path))
        written = {k for k in JOINT_DOFS if stage.GetPrimAtPath(f"/thing/joints/{k}_closure").IsValid()}
    else:
        written = {k for k in JOINT_DOFS if f'"{k}_closure"'.encode() in path.read_bytes()}
    assert left_out == (set(JOINT_DOFS) if form in ("urdf", "glb") else {"free"})
    assert written == set(JOINT_DOFS) - left_out
    assert ("p2", "p0") in robot.uncollided
    assert_good([c for c in validate(path, form, bundle, robot) if "gravity" not in c.what])


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "screw", "cylindrical", "spherical"])
def test_a_loop_allows_what_its_joint_allows(objects, tmp_path, kind):
    """The same joint twice between the same parts, once in the tree and once as a loop."""
    pytest.importorskip("mujoco")
    bundle = objects.chain([kind])
    bundle.joints.append(objects.joint("again", kind, "p0", "p1", 1, in_tree=False))
    robot = objects.robot(bundle)
    run = simulate(export(bundle, robot, "mjcf", tmp_path / "out"))
    assert run.stable and run.excess < 0.01 and run.reached > 0.9


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_loop_forbids_what_its_joint_forbids(objects, tmp_path, kind):
    """A part that turns and slides, but is in a loop that allows one of the two."""
    mujoco = pytest.importorskip("mujoco")
    bundle = objects.chain(["cylindrical"])
    bundle.joints.append(objects.joint("again", kind, "p0", "p1", 1, in_tree=False))
    robot = objects.robot(bundle)
    model = mujoco.MjModel.from_xml_path(str(export(bundle, robot, "mjcf", tmp_path / "out")))
    data = mujoco.MjData(model)
    for _ in range(1000):
        data.ctrl[:] = [0.1, 0.5]
        mujoco.mj_step(model, data)
    slide, turn = (float(data.joint(f"j1_{name}").qpos[0]) for name in ("slide", "turn"))
    if kind == "revolute":
        assert abs(slide) < 0.01 and turn == pytest.approx(0.5, abs=0.05)
    else:
        assert abs(turn) < 0.05 and slide == pytest.approx(0.1, abs=0.01)


def test_a_screw_that_closes_a_loop_lets_what_turns_slide_along(objects, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    bundle = objects.chain(["cylindrical"])
    bundle.joints.append(objects.joint("again", "screw", "p0", "p1", 1, in_tree=False, pitch=0.1))
    path = export(bundle, objects.robot(bundle), "mjcf", tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(path))
    slides = model.actuator("j1_slide").id
    model.actuator_gainprm[slides] = model.actuator_biasprm[slides] = 0.0  # goes where it is pushed
    model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    data.ctrl[model.actuator("j1_turn").id] = 0.9
    mujoco.mj_step(model, data, 1000)
    slide, turn = (float(data.joint(f"j1_{name}").qpos[0]) for name in ("slide", "turn"))
    assert turn == pytest.approx(0.9, abs=0.05) and slide == pytest.approx(0.1 * turn, abs=0.005)


def test_a_loop_that_closes_is_simulated(objects, tmp_path):
    """Two links side by side with the same hinge, and welded to each other: they turn together."""
    mujoco = pytest.importorskip("mujoco")
    names = ["base", "left", "right"]
    joints = [objects.joint(f"to {name}", "revolute", "base", name, 1) for name in names[1:]]
    joints.append(objects.joint("weld", "fixed", "left", "right", 1, in_tree=False))
    bundle = objects.make_bundle(names, joints)
    robot = objects.robot(bundle)
    path = export(bundle, robot, "mjcf", tmp_path / "out")
    assert_good(validate(path, "mjcf", bundle, robot))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for _ in range(1000):
        data.ctrl[:] = 0.8
        mujoco.mj_step(model, data)
    assert data.qpos[0] == pytest.approx(data.qpos[1], abs=0.02)
    assert data.qpos[0] == pytest.approx(0.8, abs=0.05)


def parallelogram(objects, slanted):
    """A bar on two arms, hung on one and closing a loop with the other, whose joint's axis may be `slanted`."""
    names, z = ["base", "left", "right", "bar"], torch.tensor([0.0, 0.0, 1.0]).double()
    corners = {"left": [0, 0, 0], "right": [1, 0, 0], "bar": [0, 1, 0], "far": [1, 1, 0]}
    at = {name: {"axis": z, "origin": torch.tensor(corner).double()} for name, corner in corners.items()}
    joints = [
        objects.joint("to left", "revolute", "base", "left", 1, **at["left"]),
        objects.joint("to right", "revolute", "base", "right", 1, **at["right"]),
        objects.joint("to bar", "revolute", "left", "bar", 1, **at["bar"]),
        objects.joint("closure", "revolute", "right", "bar", 1, in_tree=False, **at["far"]),
    ]
    if slanted:
        joints[-1] = dataclasses.replace(joints[-1], axis=torch.tensor([1.0, 0.0, 0.0]).double())
    for joint, values in zip(joints, ([0.0, 0.9], [0.0, 0.9], [-0.9, 0.0], [-0.9, 0.0]), strict=True):
        joint.limits = tuple(values)
    return objects.make_bundle(names, joints)


@pytest.mark.parametrize("slanted", [False, True])
def test_a_loop_moves_by_any_of_its_joints_unless_its_axes_forbid_it(objects, tmp_path, slanted):
    pytest.importorskip("mujoco")
    bundle = parallelogram(objects, slanted)
    robot = objects.robot(bundle)
    path = export(bundle, robot, "mjcf", tmp_path / "out")
    (check,) = [c for c in validate(path, "mjcf", bundle, robot) if "gravity" in c.what]
    assert check.verdict == ("note" if slanted else "passed"), check.found
    assert ("the loops hold it ('closure')" in check.found) == slanted


@pytest.mark.parametrize("form", ["urdf", "glb", "ply"])
def test_a_wrong_file_fails(objects, tmp_path, form):
    bundle = objects.chain(["revolute", "prismatic"])
    robot = objects.robot(bundle)
    path = export(bundle, robot, form, tmp_path / "out")
    other = objects.chain(["revolute", "prismatic"])
    other.joints[0].axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    other.parts[1].splat.means += 1.0
    checks = validate(path, form, other, robot)
    assert any(c.verdict == "failed" for c in checks), report(checks)


def test_an_object_too_small_for_mujocos_urdf_reader_is_said_to_be(objects, tmp_path):
    pytest.importorskip("mujoco")
    bundle = objects.chain(["revolute"])
    robot = objects.robot(bundle, scale=1e-5)
    checks = report(validate(export(bundle, robot, "urdf", tmp_path / "urdf"), "urdf", bundle, robot))
    verdict, found = checks["mujoco", "link poses"]
    assert verdict == "failed"
    assert "too small for MuJoCo's URDF reader; give a larger --scale, or --format mjcf" in found
    assert_good(validate(export(bundle, robot, "mjcf", tmp_path / "mjcf"), "mjcf", bundle, robot))


@pytest.mark.parametrize("turns", [3, 1000, -30])
def test_an_animation_goes_the_long_way_of_many_turns(objects, tmp_path, turns):
    bundle = objects.chain(["screw", "revolute"])
    bundle.joints[0].limits = tuple(sorted((0.0, turns * 2 * np.pi)))
    robot = objects.robot(bundle)
    path = export(bundle, robot, "glb", tmp_path / "out")
    assert_good(validate(path, "glb", bundle, robot))
    assert path.stat().st_size < 1e6


def test_a_screw_of_fine_pitch_passes_as_long_as_its_slide_follows_its_turn(objects, tmp_path):
    pytest.importorskip("mujoco")
    bundle = objects.chain(["screw"])
    bundle.joints[0].pitch = 1e-4
    robot = objects.robot(bundle)
    path = export(bundle, robot, "mjcf", tmp_path / "out")
    assert_good(validate(path, "mjcf", bundle, robot))
    path.write_text(path.read_text().replace('solref="0.005 1"', 'solref="1 1"'))  # loose
    (found,) = [c for c in validate(path, "mjcf", bundle, robot) if c.verdict == "failed"]
    assert "beyond limits by 0.0%" in found.found and "what follows others strayed by" in found.found


@pytest.mark.parametrize("form", ["urdf", "mjcf", "usd", "glb", "ply"])
def test_a_damaged_file_fails_without_a_traceback(objects, tmp_path, form):
    bundle = objects.chain(["revolute"])
    robot = objects.robot(bundle)
    if form in NEEDS:
        pytest.importorskip(NEEDS[form])
    path = export(bundle, robot, form, tmp_path / "out")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    checks = validate(path, form, bundle, robot)
    assert any(c.verdict == "failed" for c in checks), report(checks)


def test_a_warning_of_a_program_fails(objects, tmp_path, monkeypatch):
    class Loud:
        def __init__(self, path, robot):
            logging.getLogger("loud").warning("no mesh for you")
            warnings.warn("nor here", stacklevel=1)

        def poses(self, values):
            return {"p0": np.eye(4), "p1": np.eye(4)}

    bundle = objects.chain(["fixed"])
    robot = objects.robot(bundle)
    monkeypatch.setitem(validation._CONSUMERS, "urdf", (("loud", Loud),))
    checks = validate(tmp_path / "x.urdf", "urdf", bundle, robot)
    assert {c.found for c in checks if c.verdict == "failed"} >= {"no mesh for you", "nor here"}


def test_poses_that_are_no_numbers_fail(objects, tmp_path, monkeypatch):
    bundle = objects.chain(["fixed"])
    robot = objects.robot(bundle)
    lost = Mock(poses=Mock(return_value={"p0": np.eye(4), "p1": np.full((4, 4), np.nan)}))
    monkeypatch.setitem(validation._CONSUMERS, "urdf", (("lost", lambda path, robot: lost),))
    found = report(validate(tmp_path / "x.urdf", "urdf", bundle, robot))
    assert found["lost", "link poses"][0] == "failed"


def test_a_program_that_is_not_installed_is_said_to_be(objects, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    bundle = objects.chain(["revolute"])
    robot = objects.robot(bundle)
    found = report(validate(export(bundle, robot, "mjcf", tmp_path / "out"), "mjcf", bundle, robot))
    assert found["mujoco", "link poses"] == ("not checked", "pip install mujoco")
    assert not [v for v, _ in found.values() if v in ("failed", "passed")]


@pytest.mark.parametrize("loads", [True, False])
def test_every_server_of_pybullet_is_ended(objects, tmp_path, monkeypatch, loads):
    """Of which a process may have 1024."""
    client = 7

    def load(path, **_):
        if not loads:
            raise RuntimeError("Cannot load URDF file.")

    server = Mock(connect=Mock(return_value=client), loadURDF=load, getNumJoints=Mock(return_value=0))
    monkeypatch.setitem(sys.modules, "pybullet", server)
    bundle = objects.chain(["revolute"])
    validate(tmp_path / "x.urdf", "urdf", bundle, objects.robot(bundle))
    gc.collect()
    server.connect.assert_called_once()
    server.disconnect.assert_called_once_with(client)


def test_pose_errors_are_relative_to_the_object(objects, tmp_path):
    bundle = objects.chain(["revolute"])
    robot = objects.robot(bundle, scale=1e-3)
    path = export(bundle, robot, "glb", tmp_path / "out")
    moved = dataclasses.replace(robot, links=dict(robot.links))
    link = robot.links["p1"]
    moved.links["p1"] = dataclasses.replace(link, origin=link.origin + 1e-7)
    found = report(validate(path, "glb", bundle, moved))
    assert found["trimesh", "link poses"][0] == "failed"


def test_links_that_touch_at_rest_fail(objects, tmp_path):
    """Neighbours may, and what is known to overlap; here that is not known."""
    pytest.importorskip("mujoco")
    bundle = objects.chain(["fixed", "revolute"])
    robot = dataclasses.replace(describe(bundle, objects.shapes(bundle, size=1.6), "thing"), overlaps={})
    found = report(validate(export(bundle, robot, "mjcf", tmp_path / "out"), "mjcf", bundle, robot))
    assert found["mujoco", "contacts at rest"] == ("failed", "'p0' and 'p2'")


@pytest.mark.parametrize(("up", "sinks"), [("0 0 1", True), ("0 0 -1", True), ("1 0 0", False)])
def test_a_joint_that_sinks_beyond_either_limit_is_told(tmp_path, up, sinks):
    pytest.importorskip("mujoco")
    (tmp_path / "robot.xml").write_text(
        f"""<mujoco><worldbody><body>
        <joint name="j" type="slide" axis="{up}" range="-0.1 0.1" limited="true" solreflimit="0.5 1"/>
        <geom size="0.1" mass="50"/>
        </body></worldbody><actuator><position joint="j" kp="1" ctrlrange="-0.1 0.1"/></actuator></mujoco>"""
    )
    assert (simulate(tmp_path / "robot.xml").excess > 0.05) == sinks


def test_a_simulation_that_explodes_is_told_and_leaves_no_log_where_one_stands(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "robot.xml").write_text(
        """<mujoco><option timestep="0.5"/><worldbody><body>
        <joint name="j" type="slide" axis="1 0 0" range="-1 1" stiffness="1e9"/><geom size="0.1" mass="0.001"/>
        </body></worldbody><actuator><position joint="j" kp="1e9" ctrlrange="-1 1"/></actuator></mujoco>"""
    )
    assert not simulate(tmp_path / "robot.xml").stable
    assert not list((tmp_path / "here").iterdir())
