import numpy as np
import pytest

from splatart_ns.capture.crossings import Crossings
from splatart_ns.capture.robot import read_urdf
from splatart_ns.capture.scene import part_surfaces

BOX = '<visual><origin xyz="{}"/><geometry><box size="{}"/></geometry></visual>'
SLIDE = """<joint name="{0}" type="prismatic"><parent link="{1}"/><child link="{0}"/><axis xyz="1 0 0"/>
<limit lower="-5" upper="5"/></joint>"""


@pytest.fixture
def crossings(tmp_path):
    """Of "floor", and of "rod" and "cube", which slide along x: the rod on the floor, the cube on a link without shape
    that the rod carries."""

    def make(rod="0 0 1", cube="3 0 1", frozen=None):
        links = [
            f'<link name="floor">{BOX.format("0 0 0", "1 1 0.2")}</link>',
            f'<link name="rod">{BOX.format(rod, "0.1 0.1 2")}</link>',
            '<link name="carrier"/>',
            f'<link name="cube">{BOX.format(cube, "0.4 0.4 0.4")}</link>',
        ]
        joints = [SLIDE.format(*x) for x in (("rod", "floor"), ("carrier", "rod"), ("cube", "carrier"))]
        path = tmp_path / "robot.urdf"
        path.write_text(f'<robot name="r">{"".join(links + joints)}</robot>')
        robot = read_urdf(path)
        return robot, Crossings(robot, frozen or {}, part_surfaces(robot, frozen or {}))

    return make


def found(made, **values):
    robot, crossings = made
    return crossings.pairs(robot.complete(values), ("floor", "rod", "cube"))


def test_parts_cross_where_their_surfaces_do(crossings):
    made = crossings(cube="3 0 0")
    assert found(made) == set()
    assert found(made, cube=-2.29) == set()
    assert found(made, cube=-2.31) == {("floor", "cube")}
    assert found(made, cube=-1.2, carrier=-1.2) == {("floor", "cube")}  # all of its corners are outside
    assert found(made, rod=-2.6) == {("floor", "cube")}


def test_parts_that_a_joint_joins_may_cross(crossings):
    assert found(crossings(rod="0 0 0.5")) == set()  # through the floor, and through the cube by a link without shape
    assert found(crossings(cube="3 0 1"), cube=-3.0) == set()


def test_what_crosses_at_rest_tells_nothing(crossings):
    made = crossings(cube="0.5 0 0")
    assert found(made) == found(made, cube=-0.3) == set()


def test_rest_is_where_frozen_joints_are_held(crossings):
    assert found(crossings(cube="3 0 0", frozen={"carrier": -2.5}), carrier=-2.5) == set()


def test_only_the_parts_asked_for_count(crossings):
    robot, crossings = crossings(cube="3 0 0")
    values = robot.complete({"cube": -2.5})
    assert crossings.pairs(values, ("floor", "rod")) == set()
    assert crossings.pairs(values, ("floor", "cube")) == {("floor", "cube")}


@pytest.mark.parametrize("seed", range(5))
def test_turned_boxes_cross_as_their_corners_and_edges_tell(seed, tmp_path):
    """Against the separating axes of two boxes."""
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.2, 1.0, (2, 3))
    path = tmp_path / "robot.urdf"
    links = "".join(
        f'<link name="{n}">{BOX.format("0 0 0", " ".join(map(str, s)))}</link>'
        for n, s in zip("ab", sizes, strict=True)
    )
    joints = "".join(
        f'<joint name="{k}{n}" type="{t}"><parent link="{p}"/><child link="{c}"/><axis xyz="{a}"/>{limit}</joint>'
        for n in "ab"
        for k, t, p, c, a, limit in (
            ("x", "prismatic", "world", f"m{n}", "1 0 0", '<limit lower="-9" upper="9"/>'),
            ("u", "continuous", f"m{n}", f"n{n}", "1 1 0", ""),
            ("v", "continuous", f"n{n}", n, "0 1 1", ""),
        )
    )
    bare = '<link name="world"/>' + "".join(f'<link name="{k}{n}"/>' for k in "mn" for n in "ab")
    path.write_text(f'<robot name="r">{bare}{links}{joints}</robot>')
    robot = read_urdf(path)
    crossings = Crossings(robot, {}, part_surfaces(robot, {}))
    crossings._expected.clear()  # at rest the boxes lie in each other
    for _ in range(40):
        values = {f"{k}{n}": rng.uniform(-1, 1) * scale for n in "ab" for k, scale in (("x", 0.6), ("u", 3), ("v", 3))}
        poses = robot.link_poses(values)
        gap = separation([poses[n] for n in "ab"], sizes)
        inside = -gap > 0.5 * sizes.min()  # perhaps the one inside the other, where surfaces need not cross
        if abs(gap) > 1e-4 and not inside:
            assert bool(crossings.pairs(robot.complete(values), "ab")) == (gap < 0)


def separation(poses, sizes):
    """The widest gap between two boxes along any of the axes that can separate them, negative where they overlap."""
    R = [T[:3, :3] for T in poses]
    axes = [*R[0].T, *R[1].T, *(np.cross(a, b) for a in R[0].T for b in R[1].T)]
    gaps = []
    for axis in axes:
        if (length := np.linalg.norm(axis)) > 1e-9:
            n = axis / length
            reach = sum(0.5 * np.abs(n @ r) @ size for r, size in zip(R, sizes, strict=True))
            gaps.append(abs(n @ (poses[1][:3, 3] - poses[0][:3, 3])) - reach)
    return max(gaps)
