import pytest
import torch
from part_scene import angle_deg, box, motion, nearby, photograph

from splatart_ns.geometry.se3 import adjoint, inverse
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import reference
from splatart_ns.stages.merge import merge_parts
from splatart_ns.stages.reference import reference_states, refine_known_poses, since_reference, since_state_0
from splatart_ns.stages.visibility import clearest, visibility

EYE = torch.eye(4, dtype=torch.float64)
MOVES = [EYE, motion((0, 0, 30), (0.1, 0.2, 0.1)), motion((0, 0, 70), (0.3, 0.1, 0.2))]
BASE = box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3))
PLATE = box(2, (0.7, 0.4, 0.12), (0.1, 0.0, 0.2))


@pytest.fixture(scope="module")
def scene():
    """A base and a plate at three states, whose first does not show the plate."""
    splats = [BASE, *(Splat.cat([BASE, PLATE.transformed(T)]) for T in MOVES[1:])]
    return splats, [photograph(s, 8) for s in splats]


def test_a_part_that_state_0_hides_counts_from_the_state_that_shows_most(scene):
    splats, views = scene
    seen = [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    first, plate = reference_states(splats, seen, 2)
    assert first == 0
    amounts = [float(v[s.part_ids == 2].sum()) for s, v in zip(splats, seen, strict=True)]
    assert plate == amounts.index(max(amounts)) > 0


def test_a_part_without_gaussians_counts_from_state_0():
    splat = BASE.select(torch.arange(5))
    assert reference_states([splat, splat], [torch.ones(5)] * 2, 2) == [0, 0]


def test_motions_since_the_reference_and_since_state_0_are_each_others_inverse():
    M = torch.stack([torch.stack([T, T @ inverse(MOVES[1])]) for T in MOVES])
    known = torch.ones(3, 2, dtype=torch.bool)
    T = since_state_0(M, known)
    assert torch.allclose(T[:, 0], torch.stack(MOVES)) and torch.allclose(T[:, 1], torch.stack(MOVES))
    assert torch.allclose(since_reference(T, [0, 1]), M)
    known[0, 1] = False
    T = since_state_0(M, known)
    assert torch.equal(T[0, 1], EYE) and torch.allclose(T[1:, 1], M[1:, 1])


def test_a_part_that_state_0_hides_is_found_in_the_others_and_unknown_there(scene):
    splats, views = scene
    between = MOVES[2] @ inverse(MOVES[1])
    T = EYE.repeat(3, 2, 1, 1)
    T[2, 1] = nearby(between, 0.03)
    frozen = torch.tensor([[True, True], [True, True], [True, False]])
    known = torch.tensor([[True, False], [True, True], [True, True]])
    T, covariances, ratios, _ = refine_known_poses(splats, views, T, frozen, [0, 1], known)
    assert torch.equal(T[0], EYE.expand(2, 4, 4)) and torch.equal(T[1, 1], EYE)
    assert angle_deg(T[2, 1], between) < 0.2
    assert covariances.isfinite().flatten(2).all(-1).tolist() == known.tolist()
    assert ratios.isnan().all()  # 40 degrees are no slide
    merged = merge_parts(splats, views, T, known)
    assert len(merged[1]) > 0.8 * len(PLATE)
    goal = PLATE.transformed(MOVES[1]).means
    assert torch.cdist(merged[1].means, goal).amin(1).max() < 0.05


def test_a_part_that_did_not_stay_where_its_reference_state_has_it_is_told(scene):
    known = torch.tensor([[True, False], [True, True], [True, True]])
    *_, misfits = refine_known_poses(*scene, EYE.repeat(3, 2, 1, 1), torch.ones(3, 2) > 0, [0, 1], known)
    assert misfits.tolist() == [[False, False], [False, False], [False, True]]


@pytest.mark.parametrize("found", [True, False])
def test_a_slide_is_held_unturned_where_a_part_is_known_to_rest(found):
    """The base stays where it is: because it rests, or because no motion of it was found."""
    slide = motion((0, 0, 0), (0.2, 0.1, 0.0))
    splats = [Splat.cat([BASE, PLATE.transformed(T)]) for T in (EYE, slide)]
    T = EYE.repeat(2, 2, 1, 1)
    T[1, 1] = nearby(slide, 0.01)
    frozen, known = torch.tensor([[False, False], [True, False]]), torch.tensor([[True, True], [found, True]])
    T, *_ = refine_known_poses(splats, [photograph(s, 8) for s in splats], T, frozen, [0, 0], known)
    assert torch.equal(T[1, 1, :3, :3], EYE[:3, :3]) == found
    assert angle_deg(T[1, 1], slide) < 0.5


def test_a_pose_at_state_0_that_is_sure_turns_motions_into_those_since_state_0(scene):
    splats, views = scene
    splats = [Splat.cat([BASE, PLATE]), *splats[1:]]
    views = [photograph(splats[0], 8), *views[1:]]
    truth = torch.stack([torch.stack([EYE, T]) for T in MOVES])
    frozen = torch.tensor([[True, False], [True, True], [True, False]])
    T, covariances, *_ = refine_known_poses(splats, views, truth, frozen, [0, 1], torch.ones(3, 2) > 0)
    assert torch.allclose(T, truth, atol=5e-3)
    assert covariances.isfinite().all() and not covariances[0].any()
    # The reference state's own pose is as uncertain as the one that it was turned by.
    assert (torch.linalg.eigvalsh(covariances[1:, 1])[:, 0] > 0).all()


def test_a_motion_since_state_0_errs_as_the_poses_there_and_then_do(monkeypatch):
    C = 1e-6 * torch.eye(6, dtype=torch.float64)

    def refined(splats, views, M, frozen, clear):
        covariances = C.repeat(*M.shape[:2], 1, 1)
        covariances[0] = 0  # of the reference state
        return M, covariances, torch.zeros(M.shape[:2]) > 0

    monkeypatch.setattr(reference, "refine_poses", refined)
    monkeypatch.setattr(reference, "rotation_held_ratios", lambda *_: torch.full((2, 2), torch.nan))
    T = torch.stack([torch.stack([EYE, T]) for T in MOVES])
    splats = [Splat.cat([BASE, PLATE])] * 3
    _, covariances, *_ = refine_known_poses(splats, [[]] * 3, T, torch.zeros(3, 2) > 0, [0, 1], torch.ones(3, 2) > 0)
    there = [adjoint(move) @ C @ adjoint(move).mT for move in MOVES]
    assert torch.allclose(covariances[:, 1], torch.stack([0 * C, there[1], there[2] + C]))


def test_how_clearly_gaussians_are_seen_is_measured_where_it_is_not_given(scene, monkeypatch):
    splats, views = scene
    T = torch.stack([torch.stack([EYE, T]) for T in MOVES])
    frozen, known = torch.ones(3, 2) > 0, torch.tensor([[True, False], [True, True], [True, True]])
    told = []

    def watched(splats, views, T, frozen, clear):
        told.append(clear or [clearest(s, v) for s, v in zip(splats, views, strict=True)])
        return T, torch.zeros(*T.shape[:2], 6, 6, dtype=torch.float64), torch.zeros(T.shape[:2]) > 0

    monkeypatch.setattr(reference, "refine_poses", watched)
    given = [clearest(s, v) for s, v in zip(splats, views, strict=True)]
    for clear in (None, given):
        refine_known_poses(splats, views, T, frozen, [0, 1], known, clear=clear)
    measured, passed = told[: len(told) // 2], told[len(told) // 2 :]
    assert [[len(x) for x in of] for of in measured] == [[len(x) for x in of] for of in passed]
    # Alone, a part hides nothing of itself that the others do not hide.
    for alone, among in zip(sum(measured, []), sum(passed, []), strict=True):
        assert (alone >= among - 1e-4).all()


def test_a_part_is_not_merged_from_a_state_where_its_pose_is_not_known(scene):
    splats, views = scene
    known = torch.tensor([[True, True], [True, True], [True, False]])
    merged = merge_parts(splats, views, torch.stack([torch.stack([EYE, EYE])] * 3), known)
    goal = PLATE.transformed(MOVES[1]).means
    assert torch.cdist(merged[1].means, goal).amin(1).max() < 0.05
