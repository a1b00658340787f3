import math
from dataclasses import replace

import pytest
import torch

from splatart_ns.geometry.se3 import inverse, se3_exp, translation
from splatart_ns.stages import tree_refinement
from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics
from splatart_ns.stages.joint import fit_joint
from splatart_ns.stages.joint_fit import JointFit, free_joint
from splatart_ns.stages.tree_refinement import refine_tree

AXES = torch.tensor([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]], dtype=torch.float64)
ORIGINS = torch.tensor([[0.0, 0, 0.2], [0, 0, 0.5], [0, 0, 0.9]], dtype=torch.float64)
VALUES = torch.tensor([[0.0, 0.7, -0.5, 1.1], [0, -0.9, 0.6, 0.4], [0, 0.5, 1.2, -0.8]], dtype=torch.float64)
POINTS = {
    p: torch.rand(300, 3, generator=torch.Generator().manual_seed(p), dtype=torch.float64) * 0.2
    + torch.tensor([0, 0, 0.3 * (p - 1)])
    for p in (1, 2, 3, 4)
}


def chain() -> KinematicTree:
    """A base and three links that turn about z, y and x, at four states."""
    joints = []
    for k in range(3):
        along = AXES[k] @ (POINTS[k + 2].mean(0) - ORIGINS[k])
        fit = JointFit("revolute", AXES[k], ORIGINS[k] + along * AXES[k], 0.0, VALUES[k], residual=0.0)
        joints.append(Joint(k + 1, k + 2, fit))
    return KinematicTree([1, 2, 3, 4], 1, joints)


def observe(sigmas: dict[int, torch.Tensor], seed: int, share: float = 0.0):
    """Motions of the chain with errors of standard deviations [6] about each part's centroid, and their covariances.

    A share of the variance is of state 0, which all the motions are counted from.
    """
    generator = torch.Generator().manual_seed(seed)
    T = dict(zip((1, 2, 3, 4), forward_kinematics(chain(), VALUES.T).unbind(1), strict=True))
    motions, errors = {}, {}
    for p in T:
        sigma = sigmas.get(p, torch.full((6,), 1e-9)).double()
        motions[p], C = T[p].clone(), torch.zeros(4, 6, 6, dtype=torch.float64)
        at_rest = translation(POINTS[p].mean(0))
        first = math.sqrt(share) * sigma * torch.randn(6, generator=generator, dtype=torch.float64)
        for s in range(1, 4):
            about = torch.eye(4, dtype=torch.float64)
            about[:3, 3] = (T[p][s, :3, :3] @ POINTS[p].mean(0)) + T[p][s, :3, 3]
            noise = math.sqrt(1 - share) * sigma * torch.randn(6, generator=generator, dtype=torch.float64)
            since_first = T[p][s] @ at_rest @ se3_exp(first) @ inverse(at_rest)
            motions[p][s] = about @ se3_exp(noise) @ inverse(about) @ since_first
            A = torch.eye(6, dtype=torch.float64)
            x, y, z = about[:3, 3]
            A[:3, 3:] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            C[s] = A @ (sigma**2).diag() @ A.T
        C[0] = torch.eye(6)
        motions[p] = motions[p] if p > 1 else T[p]
        errors[p] = C + 1e-16 * torch.eye(6)
    return motions, errors


def fitted_pairwise(motions) -> KinematicTree:
    tree = chain()
    joints = []
    for j in tree.joints:
        T_rel = inverse(motions[j.parent]) @ motions[j.child]
        joints.append(replace(j, fit=fit_joint(T_rel, POINTS[j.child], types=("revolute",))))
    return replace(tree, joints=joints)


def axis_errors(tree: KinematicTree) -> list[float]:
    return [
        math.degrees(float(torch.linalg.vector_norm(torch.linalg.cross(j.fit.axis, AXES[k]))))
        for k, j in enumerate(tree.joints)
    ]


def test_exact_motions_give_the_exact_tree():
    motions, errors = observe({}, 0)
    refined = refine_tree(fitted_pairwise(motions), POINTS, motions, errors)
    assert max(axis_errors(refined)) < 1e-6
    for j, values in zip(refined.joints, VALUES, strict=True):
        sign = torch.sign(j.fit.axis @ AXES[j.child - 2])
        assert torch.allclose(sign * j.fit.values, values, atol=1e-7)
        assert j.fit.residual < 1e-7


def test_what_one_link_hides_its_neighbours_tell():
    """The turn of link 2 about its own axis is seen to 3 degrees only, all else to 0.03."""
    fine = torch.full((6,), 5e-4)
    round_link = fine.clone()
    round_link[5] = math.radians(3)
    pairwise, whole = [], []
    for seed in range(5):
        motions, errors = observe({2: round_link, 3: fine, 4: fine}, seed)
        tree = fitted_pairwise(motions)
        pairwise.append(max(axis_errors(tree)))
        whole.append(max(axis_errors(refine_tree(tree, POINTS, motions, errors))))
    assert sum(whole) < 0.2 * sum(pairwise)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_covariances_tell_how_far_off_axes_are(share):
    """Over many draws the squared error over its variance has the mean of a chi^2 of 2 degrees of freedom."""
    sigma = torch.tensor([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
    ratios = []
    for seed in range(40):
        motions, errors = observe({2: sigma, 3: sigma, 4: sigma}, seed, share)
        refined = refine_tree(fitted_pairwise(motions), POINTS, motions, errors)
        for k, j in enumerate(refined.joints):
            error = torch.sign(j.fit.axis @ AXES[k]) * j.fit.axis - AXES[k]
            C = torch.tensor(j.fit.covariance["axis"], dtype=torch.float64)
            ratios.append(float(error @ torch.linalg.pinv(C, rtol=1e-6) @ error))
    assert 1.4 < sum(ratios) / len(ratios) < 2.6


def test_errors_of_state_0_are_told_from_those_of_the_others(monkeypatch):
    sigma = torch.full((6,), 2e-3)
    together, apart = [], []
    for seed in range(40):
        motions, errors = observe({2: sigma, 3: sigma, 4: sigma}, seed, share=0.5)
        tree = fitted_pairwise(motions)
        together += axis_errors(refine_tree(tree, POINTS, motions, errors))
        with monkeypatch.context() as patched:
            patched.setattr(tree_refinement, "_with_common_share", lambda C, T: torch.block_diag(*C))
            apart += axis_errors(refine_tree(tree, POINTS, motions, errors))
    assert sum(together) < 0.95 * sum(apart)


def test_covariances_are_of_the_errors_and_not_of_the_weights():
    """All weights alike times as large change nothing."""
    sigma = torch.tensor([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
    motions, errors = observe({2: sigma, 3: sigma, 4: sigma}, 0)
    tree = fitted_pairwise(motions)
    expected = refine_tree(tree, POINTS, motions, errors).joints
    found = refine_tree(tree, POINTS, motions, errors, {p: C / 100 for p, C in errors.items()}).joints
    for a, b in zip(found, expected, strict=True):
        assert torch.allclose(a.fit.axis, b.fit.axis, atol=1e-6)
        for name, C in b.fit.covariance.items():
            torch.testing.assert_close(torch.tensor(a.fit.covariance[name]), torch.tensor(C), rtol=1e-3, atol=1e-12)


def test_a_single_motion_has_the_errors_it_is_said_to_have():
    motions, errors = observe({3: torch.tensor([1e-3, 2e-3, 1e-3, 4e-3, 5e-3, 4e-3])}, 0)
    C = errors[3][1:2].double()
    assert torch.allclose(tree_refinement._with_common_share(C, motions[3][1:2]), C[0], rtol=1e-6, atol=1e-12)


def test_fixed_and_free_joints_stay_and_carry_what_hangs_on_them():
    motions, errors = observe({}, 0)
    tree = fitted_pairwise(motions)
    free = replace(tree.joints[1], fit=free_joint(inverse(motions[2]) @ motions[3], POINTS[3]))
    tree = replace(tree, joints=[tree.joints[0], free, tree.joints[2]])
    refined = refine_tree(tree, POINTS, motions, errors)
    assert [j.fit.type for j in refined.joints] == ["revolute", "free", "revolute"]
    T = forward_kinematics(refined, refined.observed())
    for k, p in enumerate(refined.part_ids):
        assert torch.allclose(T[:, k], motions[p], atol=1e-6)


def test_a_tree_without_moving_joints_is_left_alone():
    tree = KinematicTree([1], 1, [])
    eye = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    assert refine_tree(tree, {1: POINTS[1]}, {1: eye}, {1: torch.zeros(2, 6, 6)}) is tree


@pytest.mark.parametrize("seed", range(3))
def test_the_observed_motions_are_fitted_no_worse_than_by_pairs(seed):
    sigma = torch.tensor([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
    motions, errors = observe({2: sigma, 3: sigma, 4: sigma}, seed)
    tree = fitted_pairwise(motions)

    def cost(tree):
        T = dict(zip(tree.part_ids, forward_kinematics(tree, tree.observed()).unbind(1), strict=True))
        total = 0.0
        for p in (2, 3, 4):
            moved = torch.linalg.vector_norm((T[p] - motions[p])[:, :3], dim=(-2, -1))
            total += float(moved.square().sum())
        return total

    assert cost(refine_tree(tree, POINTS, motions, errors)) < cost(tree)
