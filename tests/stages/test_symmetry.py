import math
from dataclasses import replace

import pytest
import torch
from part_scene import angle_deg, box, disc, inverse, motion, photograph

from splatart_ns.geometry.se3 import adjoint, se3_exp, translation
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import pose_evidence, symmetry
from splatart_ns.stages.joint import fit_joint
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.pose_evidence import refine_poses
from splatart_ns.stages.refinement import NormalEquations, Refinement
from splatart_ns.stages.render_choice import DOUBTFUL_VIEWS, VIEWS
from splatart_ns.stages.symmetry import settle_turn
from splatart_ns.stages.unseen import may_have_turned

TILT = motion((30, 20, 0), (0.2, 0.1, -0.1))
"""How the part lies at state 0, so that its axis is none of the world's."""
TURNED = TILT @ motion((0, 0, 70), (0, 0, 0)) @ inverse(TILT)
EYE = torch.eye(4, dtype=torch.float64)


def scene(shape, T, **kwargs):
    """Splats and views of a part at two states, a little noise on its colours."""
    splats = tuple(shape(2, M @ TILT, **kwargs) for M in (EYE, T))
    views = tuple(photograph(s) for s in splats)
    for k, s in enumerate(splats):
        s.sh = s.sh + 0.02 * torch.randn(s.sh.shape, generator=torch.Generator().manual_seed(k))
    return splats, views


def tilted_box(part, T, size):
    return box(part, size, (0.0, 0.0, 0.0)).transformed(T)


@pytest.fixture(scope="module")
def plain():
    return scene(disc, TURNED)


@pytest.mark.parametrize("size", [(0.5, 0.08), (0.2, 0.5)])
def test_the_turn_of_a_plain_round_part_is_untold_wherever_it_is_put(size):
    splats, views = scene(disc, TURNED, size=size)
    for T in (EYE, TURNED):
        settled, untold = settle_turn(splats, views, 2, T)
        assert angle_deg(settled, EYE) < 3
        assert float(untold[3:, 3:].trace()) == pytest.approx(math.pi**2 / 3, rel=1e-6)
        axis = torch.linalg.eigh(untold[3:, 3:]).eigenvectors[:, -1]
        assert abs(float(axis @ TILT[:3, 2])) > math.cos(math.radians(2))


def test_the_untold_turn_leaves_the_axis_in_place(plain):
    """A turn of that variance about the world's origin moves with it the part's centre back to where it was."""
    _, untold = settle_turn(*plain, 2, EYE)
    twist = torch.linalg.eigh(untold).eigenvectors[:, -1]
    turn = se3_exp(2.0 * twist / twist[3:].norm())
    centre = TILT[:3, 3]
    assert (turn[:3, :3] @ centre + turn[:3, 3] - centre).norm() < 0.01


def test_a_plain_round_part_that_merely_shifted_has_not_turned():
    """A button that was pushed: whatever turn it was found with, a slide explains it."""
    along = torch.eye(4, dtype=torch.float64)
    along[:3, 3] = 0.1 * TILT[:3, 2]
    splats, views = scene(disc, along)
    settled, _ = settle_turn(splats, views, 2, along @ TURNED)
    assert angle_deg(settled, EYE) < 3
    assert (settled[:3] @ TILT[:, 3] - along[:3] @ TILT[:, 3]).norm() < 0.01


def test_a_plain_round_part_that_also_turned_otherwise_stays_where_it_was_put():
    carried = motion((40, 0, 0), (0, 0, 0)) @ TURNED
    splats, views = scene(disc, carried)
    settled, untold = settle_turn(splats, views, 2, carried)
    assert torch.equal(settled, carried)
    assert untold.any()


@pytest.fixture(scope="module")
def under_a_fork():
    """A plain disc under a part that rests: where no view looks behind that, the disc has no Gaussians."""
    fork = box(1, (0.2, 0.6, 0.3), (0.0, 0.3, 0.0)).transformed(TILT)
    splats, views = [], []
    for T in (EYE, TURNED):
        whole = disc(2, T @ TILT)
        beside, above, _ = ((whole.means.double() - TILT[:3, 3]) @ TILT[:3, :3]).T
        views.append(photograph(Splat.cat([fork, whole])))
        splats.append(Splat.cat([fork, whole.select((beside.abs() > 0.1) | (above < 0))]))
    return splats, views


def test_the_turn_of_a_round_part_that_is_hidden_in_part_is_untold(under_a_fork, monkeypatch):
    monkeypatch.setattr(symmetry, "similar_axes", lambda splat: torch.zeros(0, 3))  # as of more than is hidden here
    splats, views = under_a_fork
    settled, untold = settle_turn(splats, views, 2, EYE)
    assert torch.equal(settled, EYE)
    assert float(untold[3:, 3:].trace()) == pytest.approx(math.pi**2 / 3, rel=1e-6)
    twist = torch.linalg.eigh(untold).eigenvectors[:, -1]
    twist = twist / twist[3:].norm()
    assert abs(float(twist[3:] @ TILT[:3, 2])) > math.cos(math.radians(3))
    assert (twist[:3] + torch.linalg.cross(twist[3:], TILT[:3, 3])).norm() < 0.03  # the disc's own centre stays


@pytest.mark.parametrize(
    "weights, half_blind, told",
    [
        ([1, 1, 1, 1.2, 0.05, 1.3], True, 1),
        ([1, 1, 1, 1.2, 0.05, 1.3], False, 1),
        ([1, 1, 1, 1.2, 0.16, 1.3], True, 1),
        ([1, 1, 1, 1.2, 0.16, 1.3], False, 0),
        ([1, 1, 1, 1.2, 0.2, 1.3], True, 0),
        ([0.1, 1, 1, 1.2, 0.16, 1.3], True, 0),
        ([1, 1, 1, 1.2, 0.05, 0.06], True, 2),
    ],
    ids=["blind", "blind alone", "half blind", "half blind alone", "not blind", "more so to a shift", "to two"],
)
def test_silhouettes_are_blind_to_turns_that_they_hardly_weigh(plain, monkeypatch, weights, half_blind, told):
    H = torch.tensor(weights).double().diag()
    monkeypatch.setattr(symmetry, "normal_equations", lambda *_: NormalEquations(H[None], torch.zeros(1, 6), 0.0))
    twists, shares, least = symmetry._unseen_turns(part_pair(*plain, 2, VIEWS, 400), EYE, half_blind)
    assert len(twists) == told and torch.allclose(shares, torch.ones(told).double())
    if told:
        assert torch.allclose(twists[0, 3:].abs(), torch.tensor([0.0, 1.0, 0.0]).double())
        assert float(least[0]) == pytest.approx(sorted(weights)[0] / sorted(weights)[3])


def test_silhouettes_are_blind_to_a_turn_that_also_shifts_only_if_they_hardly_weigh_it(plain, monkeypatch):
    """Rotation is 0.8 of it."""
    mixed = torch.eye(6).double()
    mixed[:, 0], mixed[:, 4] = 0.8 * mixed[:, 4] + 0.6 * mixed[:, 0], 0.6 * mixed[:, 4] - 0.8 * mixed[:, 0]
    for weight, told in ((0.05, 1), (0.2, 0)):
        H = mixed @ torch.tensor([weight, 1, 1, 1.2, 1.1, 1.3]).double().diag() @ mixed.mT
        monkeypatch.setattr(symmetry, "normal_equations", lambda *_, H=H: NormalEquations(H[None], None, 0.0))
        assert len(symmetry._unseen_turns(part_pair(*plain, 2, VIEWS, 400), EYE, True)[0]) == told


@pytest.fixture
def hardly_round(monkeypatch):
    """More of a part is hidden, or light falls on it, so that half a turn shows."""
    monkeypatch.setattr(symmetry, "similar_axes", lambda splat: torch.zeros(0, 3))
    monkeypatch.setattr(symmetry, "_axis_of_symmetry", lambda *_: None)


def about(axis, centre=TILT[:3, 3]):
    return torch.cat([torch.linalg.cross(centre, axis), axis])


def test_a_wheel_that_is_hardly_round_may_have_turned(under_a_fork, hardly_round):
    settled, untold = settle_turn(*under_a_fork, 2, EYE)
    assert torch.equal(settled, EYE)
    tilt, _, turn = torch.linalg.eigvalsh(untold[3:, 3:])
    assert float(turn) == pytest.approx(math.pi**2 / 3, rel=1e-6)
    assert math.radians(0.3) ** 2 < float(tilt) < math.radians(5) ** 2
    twist = torch.linalg.eigh(untold).eigenvectors[:, -1]
    assert abs(float(twist[3:] @ TILT[:3, 2]) / float(twist[3:].norm())) > math.cos(math.radians(3))


def test_an_axis_may_be_as_far_astray_as_silhouettes_weigh_turns_about_it(plain):
    pair, axis = part_pair(*plain, 2, VIEWS, 400), TILT[:3, 2]
    carried = motion((0, 0, 0), (0.5, 0, 0))
    centre = pair.centroid + carried[:3, 3]
    spread = symmetry._astray(pair, carried, about(axis, centre), torch.tensor(0.09).double())
    to_centre = adjoint(translation(-centre))
    spread, across = to_centre @ spread @ to_centre.mT, torch.eye(3).double() - axis.outer(axis)
    assert torch.allclose(spread[3:, 3:], 0.01 * across)
    assert torch.allclose(spread[:3, :3], 0.01 * pair.radius**2 * across)
    assert torch.allclose(spread[:3, 3:], torch.zeros(3, 3).double(), atol=1e-9)


@pytest.mark.parametrize(
    "axes, share, untold", [((2, 1), 0.95, False), ((2,), 0.95, True), ((2,), 0.8, False)], ids=["two", "one", "aside"]
)
def test_of_several_axes_or_one_that_misses_it_none_is_a_hardly_round_parts(
    under_a_fork, hardly_round, monkeypatch, axes, share, untold
):
    found = torch.stack([about(TILT[:3, k]) for k in axes]), *torch.full((2, len(axes)), share)
    monkeypatch.setattr(symmetry, "_unseen_turns", lambda *_: found)
    assert bool(settle_turn(*under_a_fork, 2, EYE)[1].any()) == untold


def test_a_bar_whose_turn_silhouettes_hardly_tell_rests(hardly_round, monkeypatch):
    monkeypatch.setattr(
        symmetry, "_unseen_turns", lambda *_: (about(TILT[:3, 2])[None], torch.ones(1), 0.1 * torch.ones(1))
    )
    settled, untold = settle_turn(*scene(tilted_box, EYE, size=(0.2, 0.2, 0.8)), 2, EYE)
    assert torch.equal(settled, EYE) and not untold.any()


def by_cameras_that_are_off(scene, degrees=0.35):
    splats, views = scene
    rng = torch.Generator().manual_seed(0)
    moved = []
    for some in views:
        off = [se3_exp(math.radians(degrees) * torch.randn(6, generator=rng)) for _ in some]
        moved.append([replace(v, viewmat=d @ v.viewmat) for v, d in zip(some, off, strict=True)])
    return splats, tuple(moved)


def test_cameras_that_are_off_tell_that_a_bar_rests_and_not_that_a_wheel_does(under_a_fork):
    """All turns cost more then, so that those by a few degrees hardly cost more than none."""
    bar = by_cameras_that_are_off(scene(tilted_box, EYE, size=(0.5, 0.4, 0.3)))
    for seen, rests in ((bar, True), (by_cameras_that_are_off(under_a_fork), False)):
        pair = part_pair(*seen, 2, VIEWS, 1500)
        assert symmetry._rests(pair, EYE, about(TILT[:3, 2])) == rests


def test_what_tells_that_a_hardly_round_part_rests_may_show_in_some_of_the_views(
    under_a_fork, hardly_round, monkeypatch
):
    asked = []
    monkeypatch.setattr(symmetry, "_unseen_turns", lambda *_: (about(TILT[:3, 2])[None], torch.ones(1), torch.ones(1)))
    monkeypatch.setattr(symmetry, "_rests", lambda pair, *_: asked.append(pair) or len(asked) == 2)
    assert not settle_turn(*under_a_fork, 2, EYE)[1].any()
    assert len(asked[0].views[0]) == VIEWS < len(asked[1].views[0])


def carried(scene, T):
    """The scene whose second state moved by T as a whole."""
    splats, views = scene
    moved = [replace(v, viewmat=v.viewmat @ inverse(T).to(v.viewmat)) for v in views[1]]
    return (splats[0], splats[1].transformed(T)), (views[0], moved)


@pytest.mark.parametrize(("slide", "turned"), [(0.02, True), (0.1, False)])
def test_a_hardly_round_part_that_slid_has_not_turned(under_a_fork, hardly_round, slide, turned):
    """Of a drawer one state may hide so much that what fits best does not fit well."""
    T = motion((0, 0, 0), (0, 0, slide))
    settled, untold = settle_turn(*carried(under_a_fork, T), 2, T)
    assert torch.equal(settled, T) and bool(untold.any()) == turned


def test_of_a_part_that_turned_otherwise_silhouettes_are_not_asked(under_a_fork, monkeypatch):
    monkeypatch.setattr(symmetry, "similar_axes", lambda splat: torch.zeros(0, 3))
    T = motion((40, 0, 0), (0, 0, 0))
    settled, untold = settle_turn(*carried(under_a_fork, T), 2, T)
    assert torch.equal(settled, T) and not untold.any()


@pytest.mark.parametrize(("rise", "rested", "turned"), [(0.03, False, False), (0.15, False, True), (0.4, True, True)])
def test_what_hides_the_same_of_a_part_in_both_states_does_not_tell_that_it_rests(
    plain, monkeypatch, rise, rested, turned
):
    """A fork does: by how much the cost rises from unturned says what tells it."""
    angles = torch.arange(0, 360, symmetry.STEP).double().deg2rad()
    cost = torch.where(angles.sin().abs() + (angles.cos() < 0) > math.sin(math.radians(symmetry.DIP)), 1 + rise, 1.0)
    monkeypatch.setattr(symmetry, "_swept", lambda *_: (angles, cost))
    pair = part_pair(*plain, 2, VIEWS, 400)
    upright = about(torch.tensor([0.0, 0.0, 1.0]).double(), torch.zeros(3).double())
    assert symmetry._told_turn(pair, EYE, upright)[1] == rested
    assert symmetry._told_turn(pair, motion((0, 0, 40), (0, 0, 0)), upright)[1] == turned


def test_what_tells_a_turn_in_some_of_the_views_does(monkeypatch):
    """A mark that the few views of the first look miss: they are of a plain disc."""
    plain, marked = scene(disc, TURNED), scene(disc, TURNED, mark=True)
    looks = []

    def looked(splats, views, part, count, pixels):
        looks.append(count)
        return part_pair(*(marked if count == DOUBTFUL_VIEWS else plain), part, VIEWS, pixels)

    monkeypatch.setattr(symmetry, "part_pair", looked)
    settled, untold = settle_turn(*plain, 2, EYE)
    assert looks == [VIEWS, DOUBTFUL_VIEWS]
    assert angle_deg(settled, TURNED) < 6
    assert not untold.any()


def test_a_mark_on_a_round_part_tells_its_turn():
    splats, views = scene(disc, TURNED, mark=True)
    for T in (EYE, TURNED):
        settled, untold = settle_turn(splats, views, 2, T)
        assert angle_deg(settled, TURNED) < 6
        assert not untold.any()


@pytest.mark.parametrize("size", [(0.7, 0.4, 0.12), (0.2, 0.2, 0.8), (0.5, 0.5, 0.5)])
def test_a_box_is_left_alone(size):
    splats, views = scene(tilted_box, TURNED, size=size)
    settled, untold = settle_turn(splats, views, 2, TURNED)
    assert torch.equal(settled, TURNED)
    assert not untold.any()


def poses(splats, views, T):
    """Poses and covariances after the last refinement of the part, held at T."""
    start = torch.stack([EYE.expand(2, 4, 4), torch.stack([EYE, T])])
    return refine_poses(splats, views, start, torch.ones(2, 2, dtype=torch.bool))[:2]


def test_a_plain_disc_that_seems_still_may_have_turned_and_its_joint_says_so(plain):
    T, covariance = poses(*plain, EYE)
    assert torch.equal(T[1, 1], EYE)
    assert may_have_turned(covariance[:, 1]).tolist() == [False, True]
    joint = fit_joint(T[:, 1], plain[0][0].means.double(), covariance=covariance[:, 1], object_radius=1.0)
    assert joint.type == "fixed"
    assert joint.ambiguous
    assert "revolute" in [other["type"] for other in joint.alternatives]
    assert any("turned unseen" in note for note in joint.undetermined)


def test_a_marked_disc_that_seems_still_is_turned_to_where_its_mark_is():
    T, covariance = poses(*scene(disc, TURNED, mark=True), EYE)
    assert angle_deg(T[1, 1], TURNED) < 6  # so near with 10 views of 64 pixels and its light against it
    assert not may_have_turned(covariance[:, 1]).any()


@pytest.mark.parametrize(("slip", "held"), [(8, True), (40, False)])
def test_a_turn_that_even_light_does_not_tell_is_as_uncertain_as_it_slips(plain, monkeypatch, slip, held):
    slipped = TILT @ motion((0, 0, -slip), (0, 0, 0)) @ inverse(TILT)

    def ends(pair, T, iterations=20, **_):
        return Refinement(slipped @ T if pair.even_light and iterations else T, 0.0, True, 1, None)

    def covariance(pair, T, equations=None):
        return torch.zeros(6, 6).to(T)

    monkeypatch.setattr(pose_evidence, "settle_turn", lambda *_: (TURNED, torch.zeros(6, 6).double()))
    monkeypatch.setattr(pose_evidence, "refine", ends)
    monkeypatch.setattr(pose_evidence, "motion_covariance", covariance)
    monkeypatch.setattr(pose_evidence, "_slid_a_little", lambda *_: None)
    T, uncertain = poses(*plain, slipped @ TURNED)
    sigma = torch.linalg.eigvalsh(uncertain[1, 1, 3:, 3:])[-1].sqrt()
    if held:
        assert torch.allclose(T[1, 1], TURNED)
        assert math.degrees(float(sigma)) == pytest.approx(slip)
    else:
        assert angle_deg(T[1, 1], TURNED) == pytest.approx(slip)  # as it came
        assert float(sigma) == pytest.approx(math.pi / math.sqrt(3))
