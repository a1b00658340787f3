import math
from dataclasses import replace

import pytest
import torch
from part_scene import NUM_PARTS, angle_deg, box, disc, motion, photograph, two_states

from splatart_ns.geometry.se3 import transform_points
from splatart_ns.geometry.similarity import inverse_similarity, rigid_of, scale_of, similarity
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import world
from splatart_ns.stages.initial_motion import initial_motion
from splatart_ns.stages.registration import part_points
from splatart_ns.stages.visibility import visibility
from splatart_ns.stages.world import (
    WorldFit,
    anchors,
    fit_world,
    fit_worlds,
    moved_splat,
    moved_views,
    resting_part,
    world_record,
    world_sentence,
)

TURN = motion((10, 0, 40), (0.3, -0.2, 0.1))
ROOM = Splat.cat([box(0, (1.6, 1.2, 0.1), (0.3, 0.2, -0.6)), box(0, (0.2, 0.2, 0.8), (0.9, 0.6, 0.0))])


def apart(scale):
    """Both states of the object, the second in a world of its own, and the way there."""
    splats, views = two_states(TURN)
    M = motion((100, -60, 40), (0.3, 0.2, -0.2))
    T = similarity(scale, M[:3, :3], M[:3, 3])
    return (splats[0], moved_splat(splats[1], T)), (views[0], moved_views(views[1], T)), T


def test_depth_grows_with_the_world():
    _, (views, _) = two_states(TURN)
    view = replace(views[0], depth=torch.full((4, 4), 2.0))
    first, second = moved_views([view, views[1]], similarity(1.5, TURN[:3, :3], TURN[:3, 3]))
    assert second.depth is None and torch.allclose(first.depth, torch.tensor(3.0))


@pytest.mark.parametrize(("scale", "with_scale"), [(1.6, True), (1.0, False)])
def test_a_resting_part_brings_worlds_together(scale, with_scale):
    splats, views, T = apart(scale)
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    assert anchors(splats, seen, NUM_PARTS) == [1, 2]
    part, (found,) = fit_worlds(splats, views, seen, [1, 2], with_scale)
    there = inverse_similarity(T)
    assert part == 1
    assert float(scale_of(found.T @ T)) == pytest.approx(1, abs=2e-3 if with_scale else 1e-12)
    assert angle_deg(rigid_of(found.T), rigid_of(there)) < 0.5  # an eighth of a pixel
    assert float(found.covariance[6, 6].sqrt()) < 5e-3 and (float(found.covariance[6, 6]) > 0) == with_scale
    corners = transform_points(T, torch.tensor([[0.45, 0.3, -0.3], [-0.45, -0.3, -0.15]]).double())
    assert torch.allclose(transform_points(found.T, corners), transform_points(there, corners), atol=3e-3)


def test_a_part_has_its_size_when_it_is_registered_though_its_radii_mislead(monkeypatch):
    splats, views, T = apart(1.6)
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    back = transform_points(inverse_similarity(T), splats[1].means.double())
    seen[1] = torch.where((splats[1].part_ids == 1) & (back[:, 0] > 0.1), 0.0, seen[1])  # as if another part hid it
    radii = [part_points(s, v, 1).radius for s, v in zip(splats, seen, strict=True)]
    assert abs(math.log(1.6 * radii[0] / radii[1])) > 0.15
    sizes = []

    def found(zoomed, *arguments):
        sizes.append(float(zoomed[1].scales.mean() / splats[0].scales.mean()))
        return initial_motion(zoomed, *arguments)

    monkeypatch.setattr(world, "initial_motion", found)
    found = fit_world(splats, views, seen, 1, with_scale=True)
    assert sizes == [pytest.approx(1, abs=world.SIZED)]
    assert float(scale_of(found.T @ T)) == pytest.approx(1, abs=2e-3)
    assert angle_deg(rigid_of(found.T), rigid_of(inverse_similarity(T))) < 0.5


@pytest.mark.parametrize(("with_scale", "words"), [(False, "let its scale be found (--worlds similar)"), (True, None)])
def test_a_world_of_another_scale_is_to_be_brought_together_with_its_scale(with_scale, words):
    splats, views, _ = apart(2.5)
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    part, (found,) = fit_worlds(splats, views, seen, [1, 2], with_scale)
    sentence = world_sentence(world_record("state_01", f"part {part}", found.T, found), "state_00")
    assert words in sentence if words else "fit badly" not in sentence


def test_a_record_says_how_certain_scale_and_turn_are_in_their_own_units():
    M = motion((0, 30, 0), (1, 2, 3))
    T = similarity(2.0, M[:3, :3], M[:3, 3])
    deviations = torch.tensor([9.0, 9.0, 9.0, 0.01, 0.02, 0.02, 0.005], dtype=torch.float64)
    record = world_record("state_01", "body", T, WorldFit(T, deviations.square().diag(), ratio=1.0))
    assert record["scale"] == pytest.approx(2) and record["scale_deviation"] == pytest.approx(0.01)
    assert record["turn_deviation_degrees"] == pytest.approx(math.degrees(0.03))
    sentence = world_sentence(record, "state_00")
    assert "scale 2.00000 +- 0.01000, turned by 30.00 +- 1.72 deg" in sentence


def turned_over(monkeypatch):
    """Lets a part be found turned over first, and as it is among what looks alike."""
    over = motion((180, 0, 0), (0, 0, -0.6))

    def found(*arguments):
        motion_found = initial_motion(*arguments)
        return replace(motion_found, T=motion_found.T @ over, alike=(motion_found.T,))

    monkeypatch.setattr(world, "initial_motion", found)


def test_of_turns_by_which_a_part_looks_alike_the_one_that_fits_best_brings_worlds_together(monkeypatch):
    splats, views, T = apart(1.6)
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    turned_over(monkeypatch)
    found = fit_world(splats, views, seen, 1, with_scale=True)
    assert angle_deg(rigid_of(found.T), rigid_of(inverse_similarity(T))) < 0.5 and not found.doubtful


@pytest.mark.parametrize(("worse", "doubtful"), [(1.04, True), (1.06, False)])
def test_a_world_is_doubtful_where_a_quite_other_turn_fits_hardly_worse(monkeypatch, worse, doubtful):
    splats, views, _ = apart(1.0)
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    turned_over(monkeypatch)
    costs, refine = iter([worse, 1.0]), world.refine

    def refined(pair, T, steps, **options):
        end = refine(pair, T, steps, **options)
        return replace(end, cost=next(costs)) if steps == world.FEW else end

    monkeypatch.setattr(world, "refine", refined)
    found = fit_world(splats, views, seen, 1, with_scale=False)
    assert next(costs, None) is None and found.doubtful == doubtful
    told = world_record("state_01", "body", found.T, found)
    assert ("quite other turn" in world_sentence(told, "state_00")) == doubtful == told["doubtful"]


@pytest.mark.parametrize("same_room", [True, False])
def test_surroundings_tell_which_of_turns_that_fit_alike_is_right(monkeypatch, same_room):
    splats, views, T = apart(1.6)
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    turned_over(monkeypatch)
    costs, refine = iter([1.0, 1.04, 1.04]), world.refine  # the wrong one fits better

    def refined(pair, T, steps, **options):
        end = refine(pair, T, steps, **options)
        return replace(end, cost=next(costs)) if steps == world.FEW else end

    monkeypatch.setattr(world, "refine", refined)
    elsewhere = moved_splat(ROOM if same_room else ROOM.transformed(motion((0, 0, 0), (9, 9, 9))), T)
    found = fit_world(splats, views, seen, 1, with_scale=True, around=(ROOM, elsewhere))
    right = angle_deg(rigid_of(found.T), rigid_of(inverse_similarity(T))) < 5
    assert right == same_room and found.doubtful != same_room


def test_surroundings_tell_how_a_round_part_is_turned(monkeypatch):
    """All turns of it fit about alike, and the right one is not among those that were found."""
    M = motion((100, -60, 40), (0.3, 0.2, -0.2))
    T = similarity(1.6, M[:3, :3], M[:3, 3])
    part = disc(1, torch.eye(4).double(), mark=True)
    splats = part, moved_splat(part, T)
    views = photograph(part), moved_views(photograph(part), T)
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    refine = world.refine

    def found(*arguments):
        wrong = [M @ motion((0, 0, degrees), (0, 0, 0)) for degrees in (100, 210)]
        return replace(initial_motion(*arguments), T=wrong[0], alike=wrong[1:])

    def refined(pair, T, steps, **options):
        end = refine(pair, T, steps, **options)
        return replace(end, cost=1.0) if steps == world.FEW else end

    monkeypatch.setattr(world, "refine", refined)
    monkeypatch.setattr(world, "initial_motion", found)
    there = fit_world(splats, views, seen, 1, with_scale=True, around=(ROOM, moved_splat(ROOM, T)))
    assert angle_deg(rigid_of(there.T), rigid_of(inverse_similarity(T))) < 1 and not there.doubtful


def rests(anchor: int, room=(ROOM, ROOM), known=True) -> int | None:
    """Which of three parts rests, of which the second is turned against the others, seen from the anchor."""
    splats, views = two_states(TURN)
    motions = torch.eye(4).double().repeat(2, 3, 1, 1)
    motions[1, 1:] = torch.stack([TURN, motion((0, 0, 0), (0.02, 0, 0))])  # the third is found less exactly
    seen_from = motions[1, anchor - 1].inverse()
    motions[1] = seen_from @ motions[1]
    points = part_points(splats[0], visibility(splats[0], views[0]), min(anchor, 2))
    noise = 0.03 * torch.randn(room[1].means.shape, generator=torch.Generator().manual_seed(0))
    brought = room[0], replace(room[1], means=room[1].means + noise).transformed(seen_from)
    parts = sorted([3, 1, 2], key=lambda part: part != anchor)
    return resting_part(brought, motions, torch.tensor([[True] * 3, [known] * 3]), points, parts)


def test_the_part_rests_that_surroundings_move_with():
    assert rests(2) == 3  # the first of two
    assert rests(1) is None and rests(3) is None


def test_surroundings_that_do_not_tell_leave_the_part_at_rest_that_brought_worlds_together():
    elsewhere = ROOM.transformed(motion((0, 0, 0), (9, 9, 9)))
    turned = ROOM.transformed(motion((50, 80, 20), (0, 0, 0)))
    nothing = ROOM.select(torch.zeros(len(ROOM.means), dtype=torch.bool))
    for other in (elsewhere, turned, nothing):
        assert rests(2, (ROOM, other)) is None
    assert rests(2, known=False) is None


def test_haze_at_one_edge_makes_no_world_larger(monkeypatch):
    clean, _ = two_states(TURN)
    views = tuple(photograph(s, 24, 96) for s in clean)
    row = torch.linspace(-0.3, 0.3, 15)
    haze = replace(
        clean[1].select(torch.arange(len(row))),
        means=torch.stack([torch.full_like(row, 0.58), row, torch.full_like(row, -0.3)], -1),
        log_scales=torch.full((len(row), 3), math.log(0.05)),
        opacity_logits=torch.full((len(row),), 1.0),
    )
    splats = clean[0], Splat.cat([clean[1], haze])
    seen = tuple(visibility(s, v) for s, v in zip(splats, views, strict=True))

    def error():
        return abs(float(scale_of(fit_world(splats, views, seen, 1, with_scale=True).T)) - 1)

    clear = error()
    monkeypatch.setattr(world, "without_haze", lambda pair, T, free: pair)
    assert clear < 0.5 * error()


def test_a_part_that_is_not_seen_brings_nothing_together():
    splats, views, _ = apart(1.0)
    hidden = splats[0], splats[1].select(splats[1].part_ids == 1)
    seen = [visibility(s, v) for s, v in zip(hidden, views, strict=True)]
    assert fit_world(hidden, views, seen, 2, with_scale=True) is None
    assert fit_worlds(hidden, views, seen, [2], with_scale=True) is None
