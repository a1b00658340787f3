import pytest
import torch

from splatart_ns.geometry.se3 import from_rotation_translation
from splatart_ns.stages.contact import Contact, find_contacts
from splatart_ns.stages.joint_parameters import joint_motion


def box(low, high, count=1500, seed=0):
    """Points in a box."""
    x = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    low, high = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    return low + x * (high - low)


def slide(*steps):
    return from_rotation_translation(torch.eye(3, dtype=torch.float64), torch.tensor(steps, dtype=torch.float64))


def test_gap_is_the_largest_over_the_states():
    points = {1: box((0, 0, 0), (1, 1, 1)), 2: box((1, 0, 0), (2, 1, 1), seed=1)}
    still = slide((0, 0, 0), (0, 0, 0))
    assert find_contacts(points, {1: still, 2: still})[1, 2].gap < 0.07
    apart = slide((0, 0, 0), (0.5, 0, 0))
    assert find_contacts(points, {1: still, 2: apart})[1, 2].gap == pytest.approx(0.5, abs=0.07)
    # Moving together changes nothing.
    assert find_contacts(points, {1: apart, 2: apart})[1, 2].gap < 0.07


def test_a_small_part_touches_a_large_one():
    points = {1: box((0, 0, 0), (1, 1, 1), 2000), 7: box((1, 0.5, 0.5), (1.1, 0.52, 0.52), 300, seed=1)}
    still = slide((0, 0, 0), (0, 0, 0))
    assert find_contacts(points, {1: still, 7: still})[1, 7].gap < 0.07


def test_what_stays_in_touch_lies_at_the_hinge():
    points = {1: box((0, 0, 0), (1, 0.05, 1)), 2: box((1, 0, 0), (2, 0.05, 1), seed=1)}
    axis, hinge = torch.tensor([0, 0, 1.0]).double(), torch.tensor([1, 0, 0.0]).double()
    motions = {
        1: slide((0, 0, 0), (0, 0, 0)),
        2: joint_motion("revolute", axis, hinge, 0.0, torch.tensor([0, 1.3]).double()),
    }
    contact = find_contacts(points, motions)[1, 2]
    assert contact.distance_to_axis(axis, hinge) < 0.06
    assert contact.distance_to_axis(axis, hinge + torch.tensor([0.7, 0, 0]).double()) > 0.6


def test_large_parts_are_thinned():
    points = {1: box((0, 0, 0), (1, 1, 1), 9000), 2: box((1, 0, 0), (2, 1, 1), 9000, seed=1)}
    still = slide((0, 0, 0), (0, 0, 0))
    contact = find_contacts(points, {1: still, 2: still})[1, 2]
    assert len(contact.points) == 36  # 1 % of 9000 / 5 on either side


def test_a_point_passes_by_both_parts():
    a, b = torch.zeros(200, 3).double(), torch.tensor([3.0, 0.0, 0.0]).double().repeat(200, 1)
    contact = Contact(0.0, a[:1], (a, b))
    assert contact.distance_to_point(torch.tensor([1.0, 0.0, 0.0]).double()) == pytest.approx(1 + 2)


def test_an_axis_passes_through_what_lies_all_around_it_and_by_what_does_not():
    """A panel with a hole behind a knob: the knob's axis goes through the hole, another passes beside the panel."""
    panel = box((-1.0, -1.0, -0.02), (1.0, 1.0, 0.0))
    panel = panel[panel[:, :2].norm(dim=1) > 0.3]
    knob = box((-0.25, -0.25, 0.02), (0.25, 0.25, 0.2), seed=1)
    contact = Contact(0.02, knob[:1], (panel, knob))
    z = torch.tensor([0.0, 0.0, 1.0], dtype=panel.dtype)
    assert contact.distance_to_axis(z, torch.zeros_like(z)) < 0.03  # of the knob's own samples
    beside = contact.distance_to_axis(z, torch.tensor([3.0, 0.0, 0.0]).to(z))
    assert beside == pytest.approx(2.0 + 2.75, abs=0.1)
    between = contact.distance_to_axis(z, torch.tensor([0.28, 0.0, 0.0]).to(z))
    assert between > 0.03
    wide = Contact(0.02, knob[:1], (panel, box((-1.0, -1.0, 0.02), (1.0, 1.0, 0.2), seed=1)))
    assert wide.distance_to_axis(z, torch.zeros_like(z)) > 0.3  # the hole is not for what is much wider
