from dataclasses import replace

import numpy as np
import pytest

from splatart_ns.bundle.joint_axis import axis_deviation, axis_line, direction_deviation, value_deviations


def test_the_deviation_of_an_axis_is_that_of_samples(bundle):
    rng = np.random.default_rng(0)
    root = 0.01 * rng.normal(size=(6, 6))
    C = root @ root.T
    samples = rng.multivariate_normal(np.zeros(6), C, size=200_000)
    blocks = {"axis": C[:3, :3], "origin": C[3:, 3:], "axis_origin": C[:3, 3:]}
    joint = replace(bundle.joints[0], covariance={name: block.tolist() for name, block in blocks.items()})
    along = np.array([-1.0, 0.0, 2.0])
    for s, found in zip(along, axis_deviation(joint, along), strict=True):
        places = samples[:, 3:] + s * samples[:, :3]
        assert found == pytest.approx(np.sqrt(np.linalg.eigvalsh(np.cov(places.T))[-1]), rel=0.02)


def test_a_line_passes_the_child_and_a_joint_without_an_axis_has_none(bundle):
    slide, hinge, ball = bundle.joints
    points = np.array([[0.5, 0.0, 0.0], [1.5, 0.0, 2.0]])
    line = axis_line(hinge, points, 1.0)
    np.testing.assert_allclose(line.points(np.array([0.0])), [[1.0, 0, 0]])
    assert line.low < 0 and line.high > 2
    assert axis_line(slide, points, 1.0).origin == pytest.approx([1.0, 0, 1.0])  # through the child
    assert axis_line(ball, points, 1.0) is None


def test_values_of_several_freedoms_have_a_deviation_each(bundle):
    ball = replace(bundle.joints[2], covariance={"values": np.diag([0, 0, 0, 1e-4, 4e-4, 9e-4]).tolist()})
    assert value_deviations(ball) == pytest.approx([0.01, 0.02, 0.03])
    assert value_deviations(replace(ball, covariance={"values": None})) is None
    assert direction_deviation(ball) is None
