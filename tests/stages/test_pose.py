import pytest
import torch
from part_scene import angle_deg, box, motion, nearby, photograph, two_states

from splatart_ns.geometry.se3 import se3_log
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.pose import PartPoses, PoseLossWeights, carry, part_extents, pose_loss, unmixed

EYE = torch.eye(4, dtype=torch.float64)


def poses(frozen=None) -> PartPoses:
    base = EYE.repeat(3, 2, 1, 1)
    base[1, 1] = motion((0, 0, 30), (1.0, 0.0, 0.0))
    base[2, 0] = motion((0, 90, 0), (0.0, 2.0, 0.0))
    centroids = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    return PartPoses(base, centroids, torch.tensor([1.0, 0.1]), frozen)


def shoot(splat: Splat, view, features=True):
    return render(
        splat,
        view.viewmat[None],
        view.K[None],
        view.width,
        view.height,
        features=splat.part_probabilities if features else None,
        with_depth=False,
    )


def test_without_increments_the_poses_are_the_base():
    p = poses()
    assert torch.allclose(p.T(), p.base, atol=1e-15)


def test_gradients_at_zero_are_finite_and_not_zero():
    p = poses()
    (p.T() * torch.randn(3, 2, 4, 4, generator=torch.Generator().manual_seed(0)).double()).sum().backward()
    for parameter in p.parameters():
        assert torch.isfinite(parameter.grad).all()
        assert (parameter.grad.abs().amax(-1) > 0).all()


def test_a_turn_leaves_the_moved_centroid_where_it_is():
    p = poses()
    with torch.no_grad():
        p.rotation.normal_()
    centroids = torch.nn.functional.pad(p.centroids, (0, 1), value=1.0)
    where = (p.T() @ centroids[:, :, None])[..., 0]
    assert torch.allclose(where, (p.base @ centroids[:, :, None])[..., 0], atol=1e-12)


def test_a_shift_is_counted_in_radii_of_the_part():
    p = poses()
    with torch.no_grad():
        p.translation[..., 0] = 1.0
    assert torch.allclose((p.T() - p.base)[1:, :, 0, 3], p.radii.expand(2, 2))


def test_state_0_and_frozen_poses_stay():
    frozen = torch.zeros(3, 2, dtype=torch.bool)
    frozen[1, 0] = True
    p = poses(frozen)
    with torch.no_grad():
        p.rotation.fill_(0.3)
        p.translation.fill_(0.2)
    same = torch.isclose(p.T(), p.base).flatten(2).all(-1)
    assert same.tolist() == [[True, True], [True, False], [False, False]]


def test_released_poses_change_and_what_slides_does_not_turn():
    p = poses()
    released, turning = torch.zeros(3, 2, dtype=torch.bool), torch.ones(3, 2, dtype=torch.bool)
    released[1], turning[1, 1] = True, False
    p.release(released, turning)
    with torch.no_grad():
        p.rotation.fill_(0.3)
        p.translation.fill_(0.2)
    change = p.T() @ p.base.inverse()
    still = torch.isclose(change, EYE).flatten(2).all(-1)
    unturned = torch.isclose(change[..., :3, :3], EYE[:3, :3]).flatten(2).all(-1)
    assert still.tolist() == [[True, True], [False, False], [True, True]]
    assert unturned.tolist() == [[True, True], [False, True], [True, True]]


def deviations(p: PartPoses, covariance: torch.Tensor) -> torch.Tensor:
    """How many standard deviations the poses are from their bases [S - 1, P]."""
    xi = se3_log(p.T()[1:].detach() @ p.base[1:].inverse())
    return (xi[..., None, :] @ torch.linalg.pinv(covariance[1:]) @ xi[..., None])[..., 0, 0].sqrt()


def test_poses_are_held_within_so_many_standard_deviations():
    g = torch.Generator().manual_seed(3)
    errors = 5e-5 * torch.randn(3, 2, 6, 20, generator=g).double()
    covariance = errors @ errors.mT / 20
    p = poses()
    with torch.no_grad():
        for parameter in p.parameters():
            parameter.copy_(1e-3 * torch.randn(parameter.shape, generator=g).double())
            parameter[1, 1] *= 1e-4
    before, far = [x.detach().clone() for x in p.parameters()], deviations(p, covariance)
    assert (far > 3).tolist() == [[True, True], [True, False]]
    p.hold_within(covariance, 3.0)
    assert torch.allclose(deviations(p, covariance), far.clamp_max(3), rtol=1e-2)
    for held, parameter in zip(p.parameters(), before, strict=True):
        assert torch.equal(held[1, 1], parameter[1, 1])
        share = (3 / far)[0, 0]
        assert torch.allclose(held[0, 0], share * parameter[0, 0], rtol=1e-2)


def test_of_what_is_known_not_to_turn_shifts_alone_are_held():
    covariance = torch.zeros(3, 2, 6, 6, dtype=torch.float64)
    covariance[..., :3, :3] = 1e-6 * torch.eye(3)
    p = poses()
    released = torch.tensor([[False, False], [True, True], [False, False]])
    p.release(released, ~released)
    with torch.no_grad():
        p.translation[..., 0] = torch.tensor([0.01, 0.01])
    p.hold_within(covariance, 3.0)
    assert p.translation[0, :, 0].tolist() == pytest.approx([0.003, 0.01])


def test_commit_keeps_the_poses_and_zeroes_the_increments():
    p = poses()
    with torch.no_grad():
        p.rotation.normal_()
        p.translation.normal_()
    before = p.T().detach()
    p.commit(p.T().detach())
    assert torch.allclose(p.T(), before, atol=1e-12)
    assert not p.rotation.any() and not p.translation.any()


def test_a_moved_state_0_is_refused():
    with pytest.raises(ValueError, match="state 0"):
        PartPoses(2 * EYE.repeat(2, 1, 1, 1), torch.zeros(1, 3), torch.ones(1))


def test_carry_moves_each_part_with_its_own_pose_and_back():
    T = torch.stack([EYE.repeat(2, 1, 1), torch.stack([EYE, motion((10, 20, 70), (0.3, 0.1, -0.2))])])
    splats, _ = two_states(T[1, 1])
    there = carry(splats, T, 0, 1)
    assert torch.allclose(there.means, splats[1].means, atol=1e-5)
    back = carry([there], T[[1, 0]], 0, 1)
    assert torch.allclose(back.means, splats[0].means, atol=1e-5)
    assert torch.equal(back.part_ids, splats[0].part_ids)


def test_carry_leaves_the_background_where_it_is():
    splat = box(0, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    T = torch.stack([EYE.repeat(2, 1, 1), motion((0, 0, 50), (1, 1, 1)).repeat(2, 1, 1)])
    assert torch.equal(carry([splat], T, 0, 1).means, splat.means)


def test_gradients_of_a_rendering_reach_the_pose():
    T = motion((0, 0, 20), (0.1, 0.0, 0.0))
    splats, views = two_states(T)
    p = PartPoses(torch.stack([EYE.repeat(2, 1, 1), EYE.repeat(2, 1, 1)]), *part_extents(splats[0], 2))
    view = views[1][0]
    losses = pose_loss(shoot(carry(splats, p.T(), 0, 1), view), view, PoseLossWeights())
    sum(losses.values()).backward()
    assert p.rotation.grad[0, 1].norm() > 0 and p.translation.grad[0, 1].norm() > 0


def test_descent_on_the_losses_finds_the_pose():
    truth = motion((0, 0, 30), (0.2, -0.1, 0.0))
    splats, views = two_states(truth)
    base = torch.stack([EYE.repeat(2, 1, 1), torch.stack([EYE, nearby(truth, 0.05, seed=1)])])
    frozen = torch.tensor([[True, True], [True, False]])
    p = PartPoses(base, *part_extents(splats[0], 2), frozen)
    optimizer = torch.optim.Adam(p.parameters(), lr=1e-2)
    steps = 90
    for k in range(steps):
        optimizer.param_groups[0]["lr"] = 1e-2 * 0.05 ** (k / steps)
        source, target = (0, 1) if k % 2 == 0 else (1, 0)
        view = views[target][(k // 2) % len(views[target])]
        losses = pose_loss(shoot(carry(splats, p.T(), source, target), view), view, PoseLossWeights())
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
    found = p.T()[1, 1].detach()
    assert angle_deg(base[1, 1], truth) > 2
    assert angle_deg(found, truth) < 1
    assert (p.centroids[1] @ (found - truth)[:3, :3].T + (found - truth)[:3, 3]).norm() < 0.01 * p.radii[1]


def test_losses_are_least_where_the_rendering_is_the_view():
    splats, views = two_states(motion((0, 0, 70), (0.2, 0, 0)))
    view = views[0][3]
    right = pose_loss(shoot(splats[0], view), view, PoseLossWeights())
    wrong = pose_loss(shoot(splats[1], view), view, PoseLossWeights())
    assert set(right) == {"l1", "ssim", "accumulation", "segmentation"}
    for name, loss in right.items():
        assert loss < 0.5 * wrong[name], name


def test_a_view_without_labels_or_alpha_lacks_their_losses():
    splats, views = two_states(EYE)
    view = views[0][0]
    view.labels = view.alpha = None
    assert set(pose_loss(shoot(splats[0], view), view, PoseLossWeights())) == {"l1", "ssim"}


def test_unlabelled_pixels_have_no_segmentation_loss():
    splats, views = two_states(EYE)
    view = views[0][0]
    view.labels[:] = 255
    losses = pose_loss(shoot(splats[0], view), view, PoseLossWeights())
    assert losses["segmentation"] == 0


def test_pixels_outside_the_mask_have_no_loss():
    splats, views = two_states(EYE)
    view = views[0][0]
    view.rgb[:, :32] = 255 - view.rgb[:, :32]
    view.labels[:, :32] = 1
    view.mask = torch.ones_like(view.labels, dtype=torch.bool)
    clean = pose_loss(shoot(splats[0], views[0][0]), view, PoseLossWeights())
    view.mask[:, :32] = False
    masked = pose_loss(shoot(splats[0], views[0][0]), view, PoseLossWeights())
    for name in ("l1", "ssim", "segmentation"):
        assert masked[name] < 0.1 * clean[name], name


def test_the_background_colour_does_not_matter_to_a_right_rendering():
    splats, views = two_states(EYE)
    view = views[0][0]
    white = pose_loss(shoot(splats[0], view), view, PoseLossWeights(), torch.ones(3))
    assert white["l1"] < 0.005


def test_mixed_gaussians_are_left_out_but_never_many_of_a_part():
    logits = torch.zeros(200, 3)
    logits[:, 1] = 8.0
    logits[:5, 2] = 8.0
    logits[100:, 2] = 7.5
    splat = box(1, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), spacing=0.1)
    splat = splat.select(torch.arange(200))
    splat.part_logits = logits
    chosen = unmixed(splat)
    assert chosen.sum() >= 180
    logits[100:, 2] = 0.0
    assert unmixed(splat).sum() == 195


def test_extents_of_a_missing_part_are_those_of_the_whole():
    splat = box(1, (1.0, 1.0, 1.0), (1.0, 0.0, 0.0))
    centroids, radii = part_extents(splat, 2)
    assert torch.allclose(centroids, torch.tensor([[1.0, 0, 0]]).double().expand(2, 3), atol=0.05)
    assert torch.isfinite(radii).all() and (radii > 0.5).all()


def test_photographs_show_both_parts():
    views = photograph(box(1, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), count=2)
    assert all((v.labels == 1).any() and (v.labels == 0).any() for v in views)
