"""A bundle is rendered, the images are fitted, and the joint that comes out is the one that went in."""

import math

import torch

from splatart_ns.bundle import load, load_bundle
from splatart_ns.bundle.dataset import Dataset, DatasetOptions
from splatart_ns.bundle.dataset_capture import write_dataset
from splatart_ns.evaluation.joints import axis_angle, point_to_line


def test_a_fit_of_a_dataset_gives_the_bundles_joint_back(hinge_fit, start_splatart, tmp_path):
    splat = load(hinge_fit)
    dataset = Dataset(splat, DatasetOptions(resolution=128))
    write_dataset(dataset, tmp_path / "capture", 28)
    process = start_splatart("fit", tmp_path / "capture", "--output-dir", tmp_path / "again", "--quality", "draft")
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    (joint,), (again,) = splat.bundle.joints, load_bundle(tmp_path / "again").joints
    assert (again.type, again.parent, again.child) == ("revolute", "base", "lid")
    assert axis_angle(again.axis, joint.axis) < 0.2
    # Measured .19 to .22 % of the radius, with the draft splats of different versions.
    assert point_to_line(joint.origin, again.axis, again.origin) < 3e-3 * splat.radius
    before, after = (dataset.configuration(state)[joint.name] for state in (0, 1))
    turn = (after - before) * torch.sign(again.axis @ joint.axis)
    assert abs(math.degrees(again.values[1] - turn)) < 0.2
