from dataclasses import replace

import numpy as np
import pytest
import torch

from splatart_ns.viewer.axis import joint_mesh

POINTS = np.array([[0.0, -0.5, 0.7], [0, 0.5, 0.7], [0.5, 0, 0.7]])


def certain(joint):
    return replace(joint, covariance={})


def test_an_arrow_lies_along_the_axis_past_the_child(bundle):
    lid = certain(bundle.joints[0])
    vertices = joint_mesh(lid, POINTS, 1.0).vertices - lid.origin.numpy()
    along, across = vertices @ lid.axis.numpy(), np.linalg.norm(np.cross(vertices, lid.axis.numpy()), axis=1)
    assert along.min() < -0.6 and along.max() > 0.6
    assert across.max() < 0.05
    tip = vertices[along.argmax()]
    assert np.linalg.norm(np.cross(tip, lid.axis.numpy())) == pytest.approx(0, abs=1e-9)


def test_an_arrow_turns_round_with_its_axis(bundle):
    lid = certain(bundle.joints[0])
    tip = joint_mesh(replace(lid, axis=-lid.axis), POINTS, 1.0).vertices[:, 1].min()
    assert tip == pytest.approx(-joint_mesh(lid, POINTS * [1, -1, 1], 1.0).vertices[:, 1].max())


def test_a_slide_is_drawn_through_its_child(bundle):
    drawer = bundle.joints[1]
    assert joint_mesh(drawer, POINTS + [0, 0, 5], 1.0).vertices[:, 2].mean() == pytest.approx(5.7, abs=0.01)


def test_an_uncertain_axis_is_thicker_and_most_at_its_ends(bundle):
    lid = bundle.joints[0]
    radius = {}
    for name, joint in {"certain": certain(lid), "uncertain": lid}.items():
        v = joint_mesh(joint, POINTS, 1.0).vertices - lid.origin.numpy()
        radius[name] = np.linalg.norm(v[v[:, 1] < -0.6][:, [0, 2]], axis=1).max()
    assert radius["uncertain"] - radius["certain"] == pytest.approx(2 * 0.01 * 0.73, rel=0.1)


def test_a_ball_is_shown_at_the_centre_of_a_spherical_joint(bundle):
    ball = replace(bundle.joints[0], type="spherical")
    mesh = joint_mesh(ball, POINTS, 1.0)
    assert mesh.centroid == pytest.approx(ball.origin.numpy(), abs=1e-6)


@pytest.mark.parametrize("kind", ["fixed", "free"])
def test_a_joint_without_an_axis_shows_none(bundle, kind):
    assert joint_mesh(replace(bundle.joints[0], type=kind), POINTS, 1.0) is None


def test_a_joint_of_a_part_without_gaussians_is_shown(bundle):
    joint = replace(bundle.joints[1], origin=torch.tensor([1.0, 2, 3], dtype=torch.float64))
    assert joint_mesh(joint, np.zeros((0, 3)), 1.0).vertices[:, 1].mean() == pytest.approx(2, abs=0.01)
