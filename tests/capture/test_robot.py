import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatart_ns.capture.robot import find_mesh, read_urdf
from splatart_ns.errors import InputError

BOX = '<visual><geometry><box size="1 1 1"/></geometry></visual>'
URDF = f"""<robot name="crane">
  <material name="paint"><color rgba="0.1 0.2 0.3 1"/></material>
  <link name="world"/>
  <link name="base">{BOX}</link>
  <link name="boom">
    <visual><origin xyz="0 0 2"/><geometry><box size="1 1 4"/></geometry><material name="paint"/></visual>
  </link>
  <link name="flange"/>
  <link name="hook"><visual><geometry><sphere radius="0.5"/></geometry></visual></link>
  <link name="left">{BOX}</link>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/><origin xyz="0 0 1"/></joint>
  <joint name="swing" type="revolute">
    <parent link="base"/><child link="boom"/>
    <origin xyz="1 0 0" rpy="0.1 -0.4 0.7"/><axis xyz="0 0 2"/><limit lower="-1" upper="2"/>
  </joint>
  <joint name="wrist" type="continuous">
    <parent link="boom"/><child link="flange"/><origin xyz="0 0 4"/><axis xyz="1 0 0"/>
  </joint>
  <joint name="hoist" type="prismatic">
    <parent link="flange"/><child link="hook"/><axis xyz="0 0 -1"/><limit lower="0.5" upper="3"/>
  </joint>
  <joint name="follow" type="revolute">
    <parent link="base"/><child link="left"/><axis xyz="0 1 0"/><limit lower="-5" upper="5"/>
    <mimic joint="swing" multiplier="-2" offset="0.25"/>
  </joint>
</robot>"""


def write(folder, text=URDF):
    path = folder / "crane.urdf"
    path.write_text(text)
    return path


def test_links_stand_where_the_chain_of_joints_puts_them(tmp_path):
    poses = read_urdf(write(tmp_path)).link_poses({"swing": 0.3, "wrist": -0.8, "hoist": 1.5})

    def move(xyz, rotation):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation.as_matrix(), xyz
        return T

    # URDF: roll about x, then pitch about y, then yaw about z, all of the fixed axes.
    turn = Rotation.from_rotvec([0, 0, 0.7]) * Rotation.from_rotvec([0, -0.4, 0]) * Rotation.from_rotvec([0.1, 0, 0])
    expected = move([0, 0, 1], Rotation.identity()) @ move([1, 0, 0], turn)
    expected = expected @ move([0, 0, 0], Rotation.from_rotvec([0, 0, 0.3]))
    assert poses["boom"] == pytest.approx(expected)
    expected = expected @ move([0, 0, 4], Rotation.from_rotvec([-0.8, 0, 0])) @ move([0, 0, -1.5], Rotation.identity())
    assert poses["hook"] == pytest.approx(expected)


def test_fixed_joints_merge_links_and_a_part_may_lack_a_shape(tmp_path):
    parts = read_urdf(write(tmp_path)).parts()
    assert [(p.name, p.links, p.has_geometry) for p in parts] == [
        ("base", ("world", "base"), True),
        ("boom", ("boom",), True),
        ("left", ("left",), True),
        ("flange", ("flange",), False),
        ("hook", ("hook",), True),
    ]
    assert parts[0].frame_link == "world"


def test_frozen_joints_merge_links_at_the_value_they_are_held_at(tmp_path):
    robot = read_urdf(write(tmp_path))
    held = {"wrist": math.pi / 2, "hoist": 1.0}
    boom = robot.parts(held)[1]
    assert boom.links == ("boom", "flange", "hook")
    corners = robot.surface(boom, held).corners.reshape(-1, 3)
    # The hook hangs along +y of the boom's frame once the wrist has turned a quarter about x.
    assert corners[:, 1].max() == pytest.approx(1.5, abs=1e-6)


def test_a_mimic_joint_follows(tmp_path):
    values = read_urdf(write(tmp_path)).complete({"swing": 0.5})
    assert values["follow"] == pytest.approx(-0.75)


def test_a_joint_without_value_stands_at_the_limit_next_to_zero(tmp_path):
    assert read_urdf(write(tmp_path)).complete({})["hoist"] == 0.5


def test_shapes_have_their_origin_and_colour(tmp_path):
    robot = read_urdf(write(tmp_path))
    boom = robot.surface(robot.parts()[1], {})
    assert boom.corners[..., 2].min() == pytest.approx(0.0)
    assert boom.corners[..., 2].max() == pytest.approx(4.0)
    assert boom.colours[0, 0] == pytest.approx([0.1, 0.2, 0.3])
    hook = robot.surface(robot.parts()[4], {})
    assert np.linalg.norm(hook.corners, axis=-1) == pytest.approx(0.5)


def test_a_capsule_has_its_caps_beyond_its_length(tmp_path):
    text = URDF.replace('<sphere radius="0.5"/>', '<capsule radius="0.5" length="2"/>')
    robot = read_urdf(write(tmp_path, text))
    corners = robot.surface(robot.parts()[4], {}).corners.reshape(-1, 3)
    assert np.abs(corners).max(axis=0) == pytest.approx([0.5, 0.5, 1.5])
    from_axis = np.linalg.norm(corners - np.clip(corners, [0, 0, -1], [0, 0, 1]), axis=-1)
    assert from_axis == pytest.approx(0.5)


def test_a_quaternion_may_stand_for_roll_pitch_and_yaw(tmp_path):
    x, y, z, w = Rotation.from_euler("xyz", [0.1, -0.4, 0.7]).as_quat()
    text = URDF.replace('rpy="0.1 -0.4 0.7"', f'quat_xyzw="{2 * x} {2 * y} {2 * z} {2 * w}"')
    poses, expected = (read_urdf(write(tmp_path, t)).link_poses({"swing": 0.3}) for t in (text, URDF))
    assert poses["hook"] == pytest.approx(expected["hook"])


def test_package_paths_are_found_above_the_urdf(tmp_path):
    folder = tmp_path / "crane_description" / "urdf"
    folder.mkdir(parents=True)
    mesh = tmp_path / "crane_description" / "meshes" / "a.stl"
    mesh.parent.mkdir()
    mesh.write_bytes(b"")
    assert find_mesh("package://crane_description/meshes/a.stl", folder / "crane.urdf") == mesh
    # A package that was unpacked under another name.
    assert find_mesh("package://other_name/meshes/a.stl", folder / "crane.urdf") == mesh
    assert find_mesh("../meshes/a.stl", folder / "crane.urdf").resolve() == mesh
    # One that has a file of the same path.
    (tmp_path / "hook/meshes").mkdir(parents=True)
    (tmp_path / "hook/meshes/a.stl").write_bytes(b"")
    assert find_mesh("package://hook/meshes/a.stl", folder / "crane.urdf") == tmp_path / "hook/meshes/a.stl"
    with pytest.raises(InputError, match="crane_description has no meshes/b.stl; put that file there"):
        find_mesh("package://crane_description/meshes/b.stl", folder / "crane.urdf")
    with pytest.raises(InputError, match="put the package 'other_name' there"):
        find_mesh("package://other_name/meshes/b.stl", folder / "crane.urdf")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("</robot>", "", "not well-formed"),
        ("robot", "sdf", "<sdf>"),
        ('xyz="0 0 4"', 'xyz="0 four"', "'0 four'"),
        ('xyz="0 0 4"', 'xyz="0 0 nan"', "'0 0 nan'"),
        ('xyz="0 0 4"', 'quat_xyzw="0 0 0 0"', "no rotation"),
        ('type="continuous"', 'type="helical"', "'helical'"),
        ('<axis xyz="0 0 2"/>', '<axis xyz="0 0 0"/>', "'swing' has the axis"),
        ('<parent link="flange"/>', "", "'hoist' lacks its <parent>"),
        ('<parent link="flange"/>', '<parent link="crown"/>', "'crown'"),
        ('<child link="hook"/>', '<child link="boom"/>', "child of two joints"),
        ('<parent link="world"/>', '<parent link="hook"/>', "hang in a loop"),
        ('<link name="flange"/>', '<link name="flange"/><link name="stray"/>', "one root link"),
        ('<link name="flange"/>', '<link name="flange"/><link name="base"/>', "two links"),
        ('joint name="hoist"', 'joint name="swing"', "two joints"),
        ('lower="0.5" upper="3"', 'lower="3" upper="0.5"', "exchange lower and upper"),
        ('joint="swing"', 'joint="mount"', "mimics 'mount'"),
        (
            '<link name="flange"/>',
            '<xacro:flange xmlns:xacro="http://www.ros.org/wiki/xacro"/><link name="flange"/>',
            "xacro",
        ),
    ],
)
def test_a_broken_urdf_is_refused_with_a_reason(tmp_path, old, new, says):
    assert old in URDF
    with pytest.raises(InputError, match=says) as refusal:
        read_urdf(write(tmp_path, URDF.replace(old, new)))
    assert "crane.urdf" in str(refusal.value)


def test_an_unknown_shape_is_refused(tmp_path):
    robot = read_urdf(write(tmp_path, URDF.replace('<sphere radius="0.5"/>', '<torus radius="0.5"/>')))
    with pytest.raises(InputError, match="<torus>"):
        robot.surface(robot.parts()[4], {})


def test_a_joint_that_is_not_there_is_answered_with_those_that_are(tmp_path):
    with pytest.raises(InputError, match="swing, wrist, hoist, follow"):
        read_urdf(write(tmp_path)).joint("elbow")


def test_a_shape_without_any_extent_is_none(tmp_path):
    robot = read_urdf(write(tmp_path, URDF.replace('<sphere radius="0.5"/>', '<sphere radius="0"/>')))
    assert robot.surface(robot.parts()[4], {}) is None


@pytest.mark.parametrize("data", [bytes(84), b"solid hook\nendsolid hook\n"], ids=["binary", "text"])
def test_an_empty_mesh_is_no_shape_and_named_in_a_warning(tmp_path, caplog, data):
    (tmp_path / "empty.STL").write_bytes(data)
    robot = read_urdf(write(tmp_path, URDF.replace('<sphere radius="0.5"/>', '<mesh filename="empty.STL"/>')))
    assert not robot.parts()[4].has_geometry
    assert "empty.STL: the mesh is empty" in caplog.text


def test_a_mesh_cut_off_before_its_triangles_is_refused(tmp_path):
    (tmp_path / "cut.stl").write_bytes(bytes(80) + (50).to_bytes(4, "little"))
    robot = read_urdf(write(tmp_path, URDF.replace('<sphere radius="0.5"/>', '<mesh filename="cut.stl"/>')))
    with pytest.raises(InputError, match="cut.stl: the mesh holds no triangles"):
        robot.surface(robot.parts()[4], {})


@pytest.mark.parametrize("type", ["planar", "floating"])
def test_a_joint_of_a_kind_that_is_not_moved_is_named_in_a_warning(tmp_path, caplog, type):
    read_urdf(write(tmp_path, URDF.replace('type="continuous"', f'type="{type}"')))
    assert f"crane.urdf: joint 'wrist' is {type}" in caplog.text


def test_a_texture_of_the_urdf_is_named_in_a_warning(tmp_path, caplog):
    read_urdf(write(tmp_path, URDF.replace("</material>", '<texture filename="wood.png"/></material>', 1)))
    assert "crane.urdf: <texture filename='wood.png'> is left out" in caplog.text
    caplog.clear()
    read_urdf(write(tmp_path, URDF.replace("</material>", '<texture filename=""/></material>', 1)))
    assert not caplog.text


@pytest.mark.parametrize("scale", ["1 1 1 1", "2"])
def test_a_mesh_scale_that_is_no_three_numbers_is_refused(tmp_path, scale):
    text = URDF.replace('<sphere radius="0.5"/>', f'<mesh filename="a.stl" scale="{scale}"/>')
    robot = read_urdf(write(tmp_path, text))
    with pytest.raises(InputError, match=f"<mesh scale='{scale}'> should hold 3 finite numbers"):
        robot.surface(robot.parts()[4], {})


def test_a_mesh_that_is_scaled_flat_is_refused(tmp_path):
    robot = read_urdf(write(tmp_path, URDF.replace('<sphere radius="0.5"/>', '<mesh filename="a.stl" scale="1 1 0"/>')))
    with pytest.raises(InputError, match="<mesh scale='1 1 0'> makes the mesh flat"):
        robot.surface(robot.parts()[4], {})
