import json
import math

import pytest

from splatart_ns.bundle import configured_motions
from splatart_ns.bundle.configurations import movable_joints, parse_settings, read_configuration, read_trajectory, sweep
from splatart_ns.errors import InputError


@pytest.fixture
def with_ball(bundle):
    """Its loop taken into the tree as a joint of three freedoms, by other parts."""
    ball = next(joint for joint in bundle.joints if joint.type == "spherical")
    bundle.joints.remove(next(joint for joint in bundle.joints if joint.name == "slide"))
    ball.in_tree, ball.parent, ball.child = True, "base", "latch"
    return bundle


def test_joints_with_a_freedom_are_movable_parents_first(bundle):
    assert list(movable_joints(bundle)) == ["hinge", "slide"]
    bundle.joints[0].type = "fixed"
    assert list(movable_joints(bundle)) == ["hinge"]


def test_values_are_radians_and_lengths_unless_degrees_are_asked_for(bundle):
    assert parse_settings(["hinge=0.5", "slide=-1e-2"], bundle) == {"hinge": 0.5, "slide": -0.01}
    assert parse_settings([" hinge = 90 deg "], bundle) == {"hinge": pytest.approx(math.pi / 2)}
    assert parse_settings(["hinge=-90DEG"], bundle) == {"hinge": pytest.approx(-math.pi / 2)}


def test_a_name_may_have_an_equals_sign(bundle):
    bundle.joints[0].name = "a=b"
    assert parse_settings(["a=b=0.5"], bundle) == {"a=b": 0.5}


def test_a_joint_may_be_called_by_the_part_that_it_moves(bundle, tmp_path):
    assert parse_settings(["door=0.5", "slide=0.1"], bundle) == {"hinge": 0.5, "slide": 0.1}
    (tmp_path / "q.json").write_text('{"door": 0.5}')
    assert read_configuration(tmp_path / "q.json", bundle) == {"hinge": 0.5}
    (tmp_path / "q.csv").write_text("latch,door\n0.1,90deg\n")
    assert read_trajectory(tmp_path / "q.csv", bundle) == [{"slide": 0.1, "hinge": pytest.approx(math.pi / 2)}]


def test_a_joint_called_in_both_ways_is_refused(bundle, tmp_path):
    (tmp_path / "q.json").write_text('{"door": 0.5, "hinge": 0.5}')
    (tmp_path / "q.csv").write_text("hinge,door\n0.1,0.1\n")
    with pytest.raises(InputError, match="'hinge' is given twice"):
        read_configuration(tmp_path / "q.json", bundle)
    with pytest.raises(InputError, match="a joint twice"):
        read_trajectory(tmp_path / "q.csv", bundle)


def test_a_joint_that_has_the_name_of_another_ones_part_is_meant_itself(bundle):
    next(joint for joint in bundle.joints if joint.name == "slide").name = "door"
    assert parse_settings(["door=0.1", "hinge=0.5"], bundle) == {"door": 0.1, "hinge": 0.5}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["base=1"], "called 'base'"),
        (["hinge=1", "door=1"], "'hinge' is set twice"),
        (["hinge"], "no '='"),
        (["nobody=1"], "called 'nobody'; there are hinge, slide"),
        (["closure=1"], "closure"),
        (["hinge=1", "hinge=2"], "twice"),
        (["hinge="], "no number"),
        (["hinge=nan"], "no number"),
        (["hinge=inf"], "no number"),
        (["hinge=1rad"], "no number"),
        (["hinge=deg"], "no number"),
        (["slide=30deg"], "give a length"),
    ],
)
def test_a_setting_that_cannot_be_used_says_why(bundle, settings, message):
    with pytest.raises(InputError, match=message):
        parse_settings(settings, bundle)


def test_a_sweep_goes_there_and_back_one_joint_after_the_other(bundle):
    frames = sweep(bundle, {}, 8)
    assert len(frames) == 16
    hinge = [q.get("hinge", 0.0) for q in frames]
    slide = [q.get("slide", 0.0) for q in frames]
    assert hinge[0] == pytest.approx(0) and hinge[4] == pytest.approx(math.pi / 2)
    assert hinge[1:4] == pytest.approx(hinge[7:4:-1])
    assert hinge[8:] == [0.0] * 8 and slide[:8] == [0.0] * 8
    assert slide[8] == pytest.approx(0) and min(slide) == pytest.approx(-0.25) and max(slide) <= 1e-12


def test_a_sweep_starts_where_the_joint_is_set_and_keeps_the_others(bundle):
    frames = sweep(bundle, {"hinge": 0.3, "slide": -0.1}, 20)
    assert frames[0] == {"hinge": pytest.approx(0.3), "slide": -0.1}
    assert frames[20] == {"hinge": 0.3, "slide": pytest.approx(-0.1)}
    assert max(q["hinge"] for q in frames) == pytest.approx(math.pi / 2, abs=0.05)


def test_a_trajectory_may_have_semicolons(with_ball, tmp_path):
    path = tmp_path / "q.csv"
    path.write_text("closure;hinge\n0.1,30deg,-1;45deg\n")
    assert read_trajectory(path, with_ball) == [
        {"closure": pytest.approx([0.1, math.pi / 6, -1]), "hinge": pytest.approx(math.pi / 4)}
    ]


def test_a_joint_of_three_freedoms_takes_three_values(with_ball):
    (closure,) = parse_settings(["closure=0.1, 30deg,-1"], with_ball).values()
    assert closure == pytest.approx([0.1, math.pi / 6, -1])
    with pytest.raises(InputError, match="is spherical; give 3"):
        parse_settings(["closure=0.1"], with_ball)
    with_ball.joints[-1].type = "free"
    with pytest.raises(InputError, match="slides"):
        parse_settings(["closure=0,0,3deg,0,0,0"], with_ball)


def test_a_joint_of_three_freedoms_sweeps_through_what_was_observed(with_ball):
    frames = [q["closure"] for q in sweep(with_ball, {"closure": [9, 9, 9]}, 8) if q["closure"] != [9, 9, 9]]
    assert len(frames) == 8
    assert frames[0] == [0, 0, 0] and frames[4] == pytest.approx([0.1, 0.2, 0.3])
    assert frames[2] == pytest.approx([0.05, 0.1, 0.15]) and frames[6] == pytest.approx(frames[2])
    assert all(set(configured_motions(with_ball, {"closure": value})) == {"base", "door", "latch"} for value in frames)


def test_a_sweep_of_joints_that_did_not_move_is_one_frame(bundle):
    for joint in bundle.joints:
        joint.limits = (0.0, 0.0)
    assert sweep(bundle, {"hinge": 0.3}, 8) == [{"hinge": 0.3}]


def test_a_sweep_stays_within_limits_that_somebody_narrowed(bundle):
    bundle.joints[1].limits = (0.0, 0.3)
    values = [q["hinge"] for q in sweep(bundle, {}, 8) if "hinge" in q]
    assert min(values) == 0.0 and max(values) == pytest.approx(0.3)


def test_a_trajectory_has_a_row_a_frame(bundle, tmp_path):
    path = tmp_path / "q.csv"
    path.write_text("\ufeffslide, hinge\n-0.1,45deg\n\n0,1.5\r\n", encoding="utf-8")
    assert read_trajectory(path, bundle) == [
        {"slide": -0.1, "hinge": pytest.approx(math.pi / 4)},
        {"slide": 0.0, "hinge": 1.5},
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "has 0 lines"),
        (b"hinge\n", "has 1 lines"),
        (b"hinge,nobody\n1,2\n", "nobody"),
        (b"time,hinge\n0,2\n", "called 'time'; there are hinge, slide; remove other columns, also of times"),
        (b"hinge;slide\n0,5;1\n", "line 2: '0,5' is 2 numbers"),
        (b"hinge,hinge\n1,2\n", "twice"),
        (b"hinge,slide\n1\n", "line 2 has 1 values"),
        (b"hinge\n1\n1,2\n", "line 3 has 2 values"),
        (b"hinge\n1\n\nx\n", "line 4: 'x'"),
        (b"hinge,slide\n1,\n", "line 2: ''"),
        (b"\xff\xfe\x00", "CSV"),
    ],
)
def test_a_trajectory_that_cannot_be_used_says_why(bundle, tmp_path, text, message):
    path = tmp_path / "q.csv"
    path.write_bytes(text)
    with pytest.raises(InputError, match=message) as error:
        read_trajectory(path, bundle)
    assert str(path) in str(error.value)


def test_a_missing_trajectory_is_named(bundle, tmp_path):
    with pytest.raises(InputError, match="none.csv"):
        read_trajectory(tmp_path / "none.csv", bundle)


def test_a_saved_configuration_is_read(with_ball, tmp_path):
    path = tmp_path / "q.json"
    saved = {"closure": [0.1, 0.2, -0.3], "hinge": 9}  # beyond the limits
    path.write_text(json.dumps(saved))
    assert read_configuration(path, with_ball) == saved
    path.write_text(json.dumps(saved), encoding="utf-8-sig")  # as some editors save it
    assert read_configuration(path, with_ball) == saved


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"nobody": 1}', "q.json: no movable joint is called 'nobody'; there are hinge, closure"),
        ('{"hinge": [1]}', "'hinge' of the file holds \\[1\\]; give a number$"),
        ('{"hinge": "30deg"}', "'hinge' of the file holds"),
        ('{"hinge": NaN}', "NaN is no number"),
        ('{"closure": [1, 2]}', "'closure' of the file holds .*shape"),
        ("[1]", "must be an object"),
        ("hinge=1", "is not JSON"),
    ],
)
def test_a_saved_configuration_that_cannot_be_used_says_why(with_ball, tmp_path, text, message):
    path = tmp_path / "q.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_configuration(path, with_ball)
    with pytest.raises(InputError, match="none.json: cannot be read .*`splatart view` saves"):
        read_configuration(tmp_path / "none.json", with_ball)
