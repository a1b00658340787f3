"""What is in the files, beyond what their readers check."""

import importlib.util
import json
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yourdfpy
from scipy.spatial.transform import Rotation

from splatart_ns.bundle.export import export, require
from splatart_ns.bundle.export.colour import linear_from_srgb
from splatart_ns.bundle.export.robot import DAMPING, EFFORT, FRICTION, GRAVITY, VELOCITY
from splatart_ns.errors import InputError
from splatart_ns.splats.ply import read_ply


@pytest.fixture
def write(objects, tmp_path):
    def write(form, kinds=("revolute", "screw"), **changes):
        bundle = objects.chain(list(kinds))
        return export(bundle, objects.robot(bundle, **changes), form, tmp_path / "out")

    return write


def glb_tree(path):
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def opened_usd(path):
    from pxr import Usd

    return Usd.Stage.Open(str(path))


def test_a_urdf_has_all_that_simulators_ask_for(write):
    root = ElementTree.parse(write("urdf")).getroot()
    for link in root.findall("link"):
        assert float(link.find("inertial/mass").get("value")) > 0
    for link in ("p0", "p1", "p2"):
        assert root.find(f"link[@name='{link}']/visual") is not None
        assert root.find(f"link[@name='{link}']/collision") is not None
    moving = [joint for joint in root.findall("joint") if joint.get("type") != "fixed"]
    assert [joint.get("name") for joint in moving] == ["j1", "j2_turn", "j2_slide"]
    for joint in moving:
        limit = {key: float(value) for key, value in joint.find("limit").items()}
        assert set(limit) == {"lower", "upper", "effort", "velocity"} and limit["lower"] < limit["upper"]
        assert limit["velocity"] == VELOCITY and limit["effort"] >= EFFORT > VELOCITY
        dynamics = {key: float(value) for key, value in joint.find("dynamics").items()}
        assert dynamics == {"damping": DAMPING, "friction": FRICTION}
        axis = np.array(joint.find("axis").get("xyz").split(), float)
        assert np.linalg.norm(axis) == pytest.approx(1, abs=1e-12)
    mimic = root.find("joint[@name='j2_slide']/mimic")
    assert mimic.get("joint") == "j2_turn" and float(mimic.get("multiplier")) == pytest.approx(0.03)


@pytest.fixture
def weighty(objects):
    """A bundle and its robot, whose masses lie beside the origins and are turned."""
    bundle = objects.chain(["revolute", "prismatic"])
    robot, R = objects.robot(bundle), Rotation.from_rotvec([0.4, -0.7, 0.9]).as_matrix()
    links = {
        name: replace(
            link,
            inertia=replace(link.inertia, centre=np.array([0.01, 0.02, -0.03]), tensor=R @ link.inertia.tensor @ R.T),
        )
        for name, link in robot.links.items()
    }
    return bundle, replace(robot, links=links)


def test_masses_are_where_they_are_and_fall_down(weighty, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    bundle, robot = weighty
    urdf, mjcf = (export(bundle, robot, form, tmp_path / form) for form in ("urdf", "mjcf"))
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    assert model.opt.gravity.tolist() == [0, 0, -GRAVITY]
    root = ElementTree.parse(urdf).getroot()
    for name, link in robot.links.items():
        inertia, body = link.inertia, model.body(name)
        own = root.find(f"link[@name='{name}']/inertial")
        np.testing.assert_allclose(np.array(own.find("origin").get("xyz").split(), float), inertia.centre, atol=1e-9)
        np.testing.assert_allclose(body.ipos, inertia.centre, atol=1e-9)
        assert float(own.find("mass").get("value")) == pytest.approx(inertia.mass) == float(body.mass[0])
        R = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
        np.testing.assert_allclose(R @ np.diag(body.inertia) @ R.T, inertia.tensor, rtol=1e-6, atol=1e-12)
        told = {key: float(value) for key, value in own.find("inertia").items()}
        of_file = [told[f"i{a}{b}"] for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")]
        np.testing.assert_allclose(of_file, inertia.tensor[np.triu_indices(3)], rtol=1e-6, atol=1e-12)


def test_masses_of_a_usd_are_where_they_are_and_fall_down(weighty, tmp_path):
    pxr = pytest.importorskip("pxr.UsdPhysics")
    stage, robot = opened_usd(export(*weighty, "usd", tmp_path / "out")), weighty[1]
    assert pxr.Scene(stage.GetPrimAtPath("/thing/scene")).GetGravityDirectionAttr().Get() == (0, 0, -1)
    for name, link in robot.links.items():
        told = pxr.MassAPI(stage.GetPrimAtPath(f"/thing/{name}"))
        assert told.GetMassAttr().Get() == pytest.approx(link.inertia.mass)
        np.testing.assert_allclose(told.GetCenterOfMassAttr().Get(), link.inertia.centre, atol=1e-8)
        q = told.GetPrincipalAxesAttr().Get()
        R = Rotation.from_quat([q.GetReal(), *q.GetImaginary()], scalar_first=True).as_matrix()
        tensor = R @ np.diag(told.GetDiagonalInertiaAttr().Get()) @ R.T
        np.testing.assert_allclose(tensor, link.inertia.tensor, rtol=1e-5, atol=1e-6)


def test_small_links_between_freedoms_add_little_to_the_mass(objects, tmp_path):
    bundle = objects.chain(["free", "screw"])
    robot = objects.robot(bundle)
    root = ElementTree.parse(export(bundle, robot, "urdf", tmp_path / "out")).getroot()
    masses = [float(mass.get("value")) for mass in root.iter("mass")]
    assert len(masses) == 3 + 5 + 1 and min(masses) > 0
    assert sum(masses) < 1.05 * sum(link.inertia.mass for link in robot.links.values())


def test_links_have_the_mean_colour_of_their_surface(write):
    urdf, mjcf = (ElementTree.parse(write(form)).getroot() for form in ("urdf", "mjcf"))
    told = [urdf.find("link[@name='p1']/visual/material/color"), mjcf.find(".//body[@name='p1']/geom[@class='visual']")]
    for element in told:
        colour = np.array(element.get("rgba").split(), float)
        np.testing.assert_allclose(colour, [200 / 255, 20 / 255, 40 / 255, 1], atol=1e-3)


def test_mesh_files_are_beside_the_description_and_in_the_links_frame(objects, write):
    path = write("urdf", scale=0.5)
    mesh = trimesh.load(path.parent / "meshes" / "p1_visual.obj")
    joint = objects.chain(["revolute", "screw"]).joints[0]
    np.testing.assert_allclose(mesh.bounds.mean(0), 0.5 * (np.array([0.7, 0.2, 0.1]) - joint.origin.numpy()), atol=1e-6)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[0], [200, 20, 40, 255])
    names = [p.relative_to(path.parent).as_posix() for p in path.parent.rglob("*.obj")]
    listed = json.loads((path.parent / "export.json").read_text())["files"]
    assert set(names) | {path.name} == set(listed)


def test_the_sed_line_of_the_docs_makes_mesh_paths_of_a_ros_package(write):
    path = write("urdf")
    docs = (Path(__file__).parents[3] / "docs/export.md").read_text()
    expression = re.search(r"sed -i '(.*)' \*\.urdf", docs)[1]
    found = subprocess.run(["sed", expression, path], capture_output=True, text=True, check=True).stdout
    files = [mesh.get("filename") for mesh in ElementTree.fromstring(found.encode()).iter("mesh")]
    assert files and all((path.parent / file.removeprefix("package://NAME/")).is_file() for file in files)
    assert all(file.startswith("package://NAME/meshes/") for file in files)


def test_an_mjcf_keeps_neighbours_from_colliding_and_drives_what_has_a_value_of_its_own(write):
    root = ElementTree.parse(write("mjcf")).getroot()
    assert [(e.get("body1"), e.get("body2")) for e in root.findall("contact/exclude")] == [("p0", "p1"), ("p1", "p2")]
    assert [a.get("joint") for a in root.findall("actuator/position")] == ["j1", "j2_turn"]
    (screw,) = root.findall("equality/joint")
    assert (screw.get("joint1"), screw.get("joint2")) == ("j2_slide", "j2_turn")
    assert len(root.findall(".//body")) == 3


def test_a_usd_is_an_articulation_fixed_to_the_world(write):
    pxr = pytest.importorskip("pxr.UsdPhysics")
    from pxr import UsdGeom

    stage = opened_usd(write("usd"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    root = stage.GetPrimAtPath("/thing/joints/world")
    assert root.HasAPI(pxr.ArticulationRootAPI) and root.IsA(pxr.FixedJoint)
    assert [str(p) for p in pxr.Joint(root).GetBody1Rel().GetTargets()] == ["/thing/p0"]
    hinge = pxr.RevoluteJoint(stage.GetPrimAtPath("/thing/joints/j1"))
    assert hinge.GetUpperLimitAttr().Get() == pytest.approx(np.degrees(1.26))
    piece = stage.GetPrimAtPath("/thing/p1/collision_0")
    assert piece.HasAPI(pxr.CollisionAPI) and pxr.MeshCollisionAPI(piece).GetApproximationAttr().Get() == "convexHull"


def test_a_usd_has_turns_in_degrees_and_motors_that_carry_the_load(objects, tmp_path):
    pxr = pytest.importorskip("pxr.UsdPhysics")
    bundle = objects.chain(["revolute", "prismatic"])
    robot = objects.robot(bundle, density=1000.0)
    stage = opened_usd(export(bundle, robot, "usd", tmp_path / "out"))
    turn, slide = (stage.GetPrimAtPath(f"/thing/joints/{name}") for name in ("j1", "j2"))
    ends = [[joint.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper")] for joint in (turn, slide)]
    np.testing.assert_allclose(ends, [np.degrees([-0.06, 1.26]), [-0.32, 0.12]], rtol=1e-6)
    turning, sliding = pxr.DriveAPI(turn, "angular"), pxr.DriveAPI(slide, "linear")
    assert turning.GetDampingAttr().Get() * np.degrees(1) == pytest.approx(DAMPING)  # a torque per degree a second
    assert sliding.GetDampingAttr().Get() == pytest.approx(DAMPING)
    weight = robot.links["p2"].inertia.mass * GRAVITY
    assert sliding.GetMaxForceAttr().Get() == pytest.approx(3 * weight) and 3 * weight > EFFORT
    assert turning.GetMaxForceAttr().Get() > 0.7 * 3 * weight  # about as many newtons, more than that far away


def test_a_usd_keeps_neighbours_from_colliding_and_locks_what_a_loop_forbids(objects, tmp_path):
    pxr = pytest.importorskip("pxr.UsdPhysics")
    bundle = objects.chain(["revolute", "prismatic"])
    bundle.joints.append(objects.joint("round", "cylindrical", "p2", "p0", 1, in_tree=False))
    stage = opened_usd(export(bundle, objects.robot(bundle), "usd", tmp_path / "out"))
    apart = set()
    for name in ("p0", "p1", "p2"):
        filtered = pxr.FilteredPairsAPI(stage.GetPrimAtPath(f"/thing/{name}")).GetFilteredPairsRel()
        apart |= {frozenset((name, path.name)) for path in filtered.GetTargets()}
    assert apart == {frozenset(pair) for pair in (("p0", "p1"), ("p1", "p2"), ("p0", "p2"))}
    loop = stage.GetPrimAtPath("/thing/joints/round")
    assert {name for name in loop.GetAppliedSchemas() if name.startswith("PhysicsLimitAPI")} == {
        f"PhysicsLimitAPI:{direction}" for direction in ("transY", "transZ", "rotY", "rotZ")
    }
    for direction in ("transY", "transZ", "rotY", "rotZ"):
        limit = pxr.LimitAPI(loop, direction)
        assert limit.GetLowAttr().Get() > limit.GetHighAttr().Get()  # as UsdPhysics has what cannot move


def test_a_usd_that_finds_no_room_is_named(write, tmp_path, small_files):
    pytest.importorskip("pxr.UsdPhysics")
    with pytest.raises(OSError, match="could not save") as error, small_files():
        write("usd")
    assert error.value.filename == str(tmp_path / "out/thing.usd")
    assert list(tmp_path.iterdir()) == []


def test_a_glb_has_a_node_per_part_and_says_how_it_moves(write):
    tree = glb_tree(write("glb"))
    nodes = {node["name"]: node for node in tree["nodes"]}
    children = {node["name"]: [tree["nodes"][i]["name"] for i in node.get("children", [])] for node in tree["nodes"]}
    assert children == {"z_up": ["p0"], "p0": ["p1"], "p1": ["p2"], "p2": []}
    assert nodes["p1"]["extras"]["freedoms"][0]["type"] == "revolute"
    assert nodes["p2"]["extras"]["freedoms"][1]["follows"] == {"name": "j2_turn", "factor": pytest.approx(0.03)}
    (sweep,) = tree["animations"]
    moved = {(tree["nodes"][c["target"]["node"]]["name"], c["target"]["path"]) for c in sweep["channels"]}
    assert moved == {("p1", "rotation"), ("p2", "rotation"), ("p2", "translation")}
    # glTF is y up: what was up in the capture is up there.
    up = np.array(nodes["z_up"]["matrix"]).reshape(4, 4).T @ [0, 0, 1, 0]
    np.testing.assert_allclose(up, [0, 1, 0, 0], atol=1e-12)


def test_colours_in_a_glb_are_of_light(write):
    path = write("glb")
    tree, data = glb_tree(path), path.read_bytes()
    primitive = next(mesh for mesh in tree["meshes"] if mesh["name"] == "p1_surface")["primitives"][0]
    view = tree["bufferViews"][tree["accessors"][primitive["attributes"]["COLOR_0"]]["bufferView"]]
    start = 28 + int.from_bytes(data[12:16], "little") + view["byteOffset"]
    colour = np.frombuffer(data, "u1", 3, start) / 255
    np.testing.assert_allclose(colour, linear_from_srgb(np.array([200, 20, 40]) / 255), atol=0.5 / 255)


def test_colours_in_a_usd_are_of_light(write):
    pytest.importorskip("pxr.UsdPhysics")
    stage = opened_usd(write("usd"))
    shown = stage.GetPrimAtPath("/thing/p1/visual").GetAttribute("primvars:displayColor").Get()
    assert len(shown) == 8
    np.testing.assert_allclose(shown, [linear_from_srgb(np.array([200, 20, 40]) / 255)] * 8, atol=1e-6)


def test_srgb_at_its_known_points():
    np.testing.assert_allclose(linear_from_srgb(np.array([0.0, 0.5, 1.0])), [0, 0.21404, 1], atol=1e-5)


def test_the_whole_ply_has_all_gaussians_in_metres(objects, write):
    bundle = objects.chain(["revolute", "screw"])
    splat = read_ply(write("ply", scale=0.5))
    for i, part in enumerate(bundle.parts):
        own = splat.select(np.arange(6) + 6 * i)
        np.testing.assert_allclose(own.means, 0.5 * part.splat.means, atol=1e-6)
        np.testing.assert_allclose(own.scales, 0.5 * part.splat.scales, rtol=1e-5)


def test_what_has_no_meshes_has_no_masses(write):
    told = [json.loads((write(form).parent / "export.json").read_text()) for form in ("urdf", "ply")]
    assert [set(about) & {"mass", "overlapping_at_rest"} for about in told] == [{"mass", "overlapping_at_rest"}, set()]


def test_a_urdf_goes_where_the_name_looks_like_an_address(objects, tmp_path):
    bundle = objects.chain(["revolute"])
    assert export(bundle, objects.robot(bundle), "urdf", tmp_path / "50% done \u00e4").is_file()


def test_a_format_that_is_none_is_refused(objects, tmp_path):
    bundle = objects.chain(["revolute"])
    with pytest.raises(InputError, match="the format is 'obj'; give one of urdf"):
        export(bundle, objects.robot(bundle), "obj", tmp_path / "out")


def test_the_same_bundle_gives_the_same_files(objects, tmp_path):
    for form in ("urdf", "mjcf", "glb", "ply"):
        texts = []
        for name in ("a", "b"):
            bundle = objects.chain(["free", "screw"])
            texts.append(export(bundle, objects.robot(bundle), form, tmp_path / name / form).read_bytes())
        assert texts[0] == texts[1]


def test_usd_without_its_library_is_refused_before_any_work(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "pxr" else find(name, *rest))
    require(["urdf", "mjcf", "glb", "ply"])
    with pytest.raises(InputError, match="pip install usd-core"):
        require(["urdf", "usd"])


def corners_of(path, form):
    """The two corners of the box about all visual meshes at rest [2, 3], as the program of a format sees it."""
    if form == "urdf":
        return yourdfpy.URDF.load(str(path)).scene.bounds
    if form == "glb":
        turned = trimesh.load_scene(path).bounds  # y is up
        return np.sort(turned @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), axis=0)
    if form == "mjcf":
        mujoco = pytest.importorskip("mujoco")
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        points = []
        for geom in np.flatnonzero(model.geom_group == 2):
            mesh = model.geom_dataid[geom]
            start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            R = data.geom_xmat[geom].reshape(3, 3)
            points.append(model.mesh_vert[start : start + count] @ R.T + data.geom_xpos[geom])
        points = np.concatenate(points)
        return np.stack([points.min(0), points.max(0)])
    UsdGeom = pytest.importorskip("pxr.UsdGeom")
    from pxr import Usd

    stage = opened_usd(path)
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(stage.GetDefaultPrim())
    aligned = box.ComputeAlignedRange()
    return np.array([aligned.GetMin(), aligned.GetMax()])


@pytest.mark.parametrize("form", ["urdf", "mjcf", "usd", "glb"])
def test_meshes_are_where_and_as_large_as_in_the_bundle(objects, write, form):
    shapes = objects.shapes(objects.chain(["revolute", "screw"]))
    corners = np.concatenate([shape.surface.bounds for shape in shapes.values()])
    expected = 0.5 * np.stack([corners.min(0), corners.max(0)])
    np.testing.assert_allclose(corners_of(write(form, scale=0.5), form), expected, atol=1e-6)
