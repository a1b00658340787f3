import numpy as np
import pytest

from splatart_ns.capture import joint_draws
from splatart_ns.capture.crossings import Crossings
from splatart_ns.capture.joint_draws import draw_configurations
from splatart_ns.capture.robot import read_urdf
from splatart_ns.capture.scene import part_surfaces

BOX = '<visual><origin xyz="{}"/><geometry><box size="{}"/></geometry></visual>'
JOINT = """<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{name}"/><origin xyz="{origin}"/>
<axis xyz="{axis}"/><limit lower="{low}" upper="{high}"/>{mimic}</joint>"""


def joint(name, parent, origin, axis, low=-2.5, high=2.5, type="revolute", mimic=""):
    return JOINT.format(**locals())


@pytest.fixture
def walker(tmp_path):
    """A body with four legs of two links each, that can swing through the body and through each other."""
    links, joints = [f'<link name="body">{BOX.format("0 0 0", "0.6 0.3 0.2")}</link>'], []
    for k, (x, y) in enumerate(((0.25, 0.2), (0.25, -0.2), (-0.25, 0.2), (-0.25, -0.2))):
        links.append(f'<link name="hip{k}"/>')
        links += [
            f'<link name="{part}{k}">{BOX.format("0 0 -0.2", "0.06 0.06 0.4")}</link>' for part in ("leg", "shin")
        ]
        joints.append(joint(f"hip{k}", "body", f"{x} {y} 0", "1 0 0"))
        joints.append(joint(f"leg{k}", f"hip{k}", "0 0 0", "0 1 0"))
        joints.append(joint(f"shin{k}", f"leg{k}", "0 0 -0.42", "0 1 0"))
    return robot_of(tmp_path, links + joints)


def robot_of(folder, elements):
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="r">{"".join(elements)}</robot>')
    robot = read_urdf(path)
    return robot, part_surfaces(robot, {})


def crossing(robot, surfaces, configurations):
    """How many pairs do, in any state or half way between the first two."""
    crossings = Crossings(robot, {}, surfaces)
    configurations = (*configurations, robot.halfway(*configurations[:2]))
    return sum(len(crossings.pairs(values, surfaces)) for values in configurations)


@pytest.mark.parametrize("states", [2, 3])
def test_parts_do_not_reach_into_each_other(walker, states, monkeypatch):
    drawn = [draw_configurations(*args(walker), states, seed) for seed in range(12)]
    assert [crossing(*walker, configurations) for configurations in drawn] == [0] * 12
    monkeypatch.setattr(joint_draws, "_TRIES", 0)
    at_once = [draw_configurations(*args(walker), states, seed) for seed in range(12)]
    assert sum(crossing(*walker, configurations) > 0 for configurations in at_once) >= 6


def test_a_joint_of_a_tiny_range_moves_too(tmp_path):
    box = '<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>'
    slide = (
        '<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0 0 0.3"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="5e-5" effort="1" velocity="1"/></joint>'
    )
    tiny = robot_of(tmp_path, [f'<link name="a">{box}</link>', f'<link name="b">{box}</link>', slide])
    first, second = draw_configurations(*args(tiny), 2, 0)
    assert 1e-5 < abs(first["slide"] - second["slide"]) < 5e-5


def test_every_joint_moves_within_its_limits(walker):
    first, second = draw_configurations(*args(walker), 2, 0)
    assert len(first) == 12 and all(abs(first[name] - second[name]) > 0.3 for name in first)
    assert all(-2.5 <= value <= 2.5 for value in (*first.values(), *second.values()))


def test_a_draw_that_can_be_is_kept(tmp_path, monkeypatch):
    links = [f'<link name="{n}">{BOX.format("0 0 0.2", "0.1 0.1 0.3")}</link>' for n in "abc"]
    robot = robot_of(
        tmp_path, [*links, joint("b", "a", "0 0 0.4", "0 1 0", -1, 1), joint("c", "b", "0 0 0.4", "0 1 0")]
    )
    configurations = draw_configurations(*args(robot), 2, 5)
    monkeypatch.setattr(joint_draws, "_TRIES", 0)
    assert configurations == draw_configurations(*args(robot), 2, 5)


def test_a_joint_that_mimics_moves_by_its_leader(tmp_path):
    mimic = '<mimic joint="left" multiplier="-1"/>'
    links = [f'<link name="palm">{BOX.format("0 0 0", "0.4 0.1 0.1")}</link>']
    links += [f'<link name="{n}">{BOX.format("0 0 0.2", "0.04 0.1 0.3")}</link>' for n in ("left", "right")]
    joints = [
        joint("left", "palm", "-0.1 0 0", "0 1 0", -1.5, 1.5),
        joint("right", "palm", "0.1 0 0", "0 1 0", -1.5, 1.5, mimic=mimic),
    ]
    robot = robot_of(tmp_path, links + joints)
    for seed in range(6):
        first, second = draw_configurations(*args(robot), 2, seed)
        assert first["right"] == -first["left"] and crossing(*robot, (first, second)) == 0


def test_what_cannot_be_otherwise_is_drawn_all_the_same(tmp_path):
    links = [
        f'<link name="a">{BOX.format("0 0 0", "1 1 1")}</link>',
        f'<link name="b">{BOX.format("0 0 2", "1 1 1")}</link>',
    ]
    links.append(f'<link name="c">{BOX.format("0 0 3", "0.2 0.2 6.4")}</link>')
    joints = [joint("b", "a", "0 0 0", "0 0 1"), joint("c", "b", "3 0 0", "1 0 0", -3, -1, "prismatic")]
    robot = robot_of(tmp_path, links + joints)
    assert len(draw_configurations(*args(robot), 2, 0)) == 2


def args(made):
    robot, surfaces = made
    return robot, {}, surfaces


def test_the_same_seed_draws_the_same_values_and_another_one_does_not(walker):
    first, again, other = (draw_configurations(*args(walker), 2, seed) for seed in (1, 1, 2))
    assert first == again != other
    assert np.isfinite([list(values.values()) for values in first]).all()


def test_a_joint_that_its_limits_hold_is_named_in_a_warning(tmp_path, caplog):
    links = [f'<link name="{name}">{BOX.format("0 0 0", "0.1 0.1 0.1")}</link>' for name in ("a", "b", "c")]
    joints = [joint("b", "a", "0 0 1", "1 0 0", 0.1, 0.1), joint("c", "a", "0 0 2", "1 0 0")]
    robot, surfaces = robot_of(tmp_path, links + joints)
    draw_configurations(robot, {}, surfaces, 2, 0)
    assert [record.getMessage().split(": ", 1)[1] for record in caplog.records] == [
        "joint 'b' has limits 0.1 to 0.1 and does not move; correct its <limit>, or make its links one part by "
        "--freeze b=0.1"
    ]
    caplog.clear()
    draw_configurations(robot, {"b": 0.1}, part_surfaces(robot, {"b": 0.1}), 2, 0)
    assert not caplog.records
