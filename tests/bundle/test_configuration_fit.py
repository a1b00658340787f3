"""The configuration of a known object in images of it."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from part_scene import box, photograph

from splatart_ns.bundle import Bundle, Joint, Part
from splatart_ns.bundle.configuration_fit import fit_configuration, sweep_values
from splatart_ns.bundle.posing import normalized, posed_splat
from splatart_ns.capture.capture import Normalization
from splatart_ns.splats import Splat

D = torch.float64
NORMALIZATION = Normalization(centre=np.array([3.0, -2.0, 1.0]), scale=0.1)
"""The object is ten times as large as what part_scene's cameras look at, and elsewhere."""


def in_capture(splat: Splat) -> Splat:
    splat.means = splat.means / NORMALIZATION.scale + torch.from_numpy(NORMALIZATION.centre).float()
    splat.log_scales = splat.log_scales - math.log(NORMALIZATION.scale)
    return splat


def joint(kind, parent, child, axis, origin, values, limits=None) -> Joint:
    origin = torch.tensor(origin, dtype=D) / NORMALIZATION.scale + torch.from_numpy(NORMALIZATION.centre)
    axis = torch.tensor(axis, dtype=D)
    return Joint(f"{parent}_{child}", kind, parent, child, axis, origin, torch.tensor(values, dtype=D), limits)


@pytest.fixture(scope="module")
def cabinet() -> Bundle:
    """base -> door (revolute) -> knob (prismatic), base -> ball (spherical)."""
    pieces = {
        "base": box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3), num_parts=4),
        "door": box(2, (0.6, 0.1, 0.4), (0.1, 0.4, 0.0), num_parts=4),
        "knob": box(3, (0.2, 0.2, 0.15), (0.25, 0.6, 0.1), num_parts=4),
        "ball": box(4, (0.3, 0.2, 0.35), (-0.4, -0.2, 0.1), num_parts=4),
    }
    motion = torch.eye(4, dtype=D).repeat(2, 1, 1)
    parts = [
        Part(k + 1, name, in_capture(splat), motion, torch.zeros(2, 6, 6, dtype=D))
        for k, (name, splat) in enumerate(pieces.items())
    ]
    return Bundle(
        parts=parts,
        joints=[
            joint("prismatic", "door", "knob", (0, 1.0, 0), (0.25, 0.6, 0.1), [0.0, 1.5], (0.0, 1.5)),
            joint("revolute", "base", "door", (0, 0, 1.0), (-0.2, 0.4, 0.0), [0.0, 0.7], (0.0, 0.7)),
            joint("spherical", "base", "ball", (0, 0, 1.0), (-0.4, -0.2, -0.1), [[0.0, 0, 0], [0.3, 0.2, 0.0]]),
        ],
        root="base",
        states=["state_00", "state_01"],
    )


def views_of(bundle, q):
    return photograph(normalized(posed_splat(bundle, q), NORMALIZATION))


def in_unit(bundle: Bundle, unit: float) -> Bundle:
    """The same object, all of its lengths multiplied by `unit`."""
    bundle = copy.deepcopy(bundle)
    for part in bundle.parts:
        part.splat.means *= unit
        part.splat.log_scales += math.log(unit)
    for own in bundle.joints:
        own.origin *= unit
        if own.type == "prismatic":
            own.values *= unit
            own.limits = tuple(unit * end for end in own.limits)
    return bundle


@pytest.mark.parametrize(("door", "knob", "unit"), [(0.4, 0.8, 1.0), (-1.3, 0.9, 1e-3), (2.9, 2.1, 1e3)])
def test_values_are_found_inside_and_beyond_the_observed_range(cabinet, door, knob, unit):
    q = {"base_door": door, "door_knob": knob, "base_ball": [0.15, 0.3, -0.1]}
    normalization = Normalization(unit * NORMALIZATION.centre, NORMALIZATION.scale / unit)
    found = fit_configuration(in_unit(cabinet, unit), views_of(cabinet, q), normalization)
    assert found.converged and found.unseen == []
    assert float(found.q["base_door"]) == pytest.approx(door, abs=6e-3)
    assert float(found.q["door_knob"]) / unit == pytest.approx(knob, abs=0.04)  # 0.004 of the object's size
    torch.testing.assert_close(found.q["base_ball"], torch.tensor(q["base_ball"], dtype=D), atol=0.02, rtol=0)


def test_the_last_part_of_a_chain_is_found_whose_values_all_lie_between_samples():
    """A bar that looks much the same turned over shows its turn only where it is put exactly."""
    places = [-0.8 + 0.3 * k for k in range(6)]
    bars = [box(k + 1, (0.32, 0.08, 0.05), (x, 0.0, 0.0), spacing=0.04, num_parts=6) for k, x in enumerate(places)]
    motion, covariance = torch.eye(4, dtype=D).repeat(2, 1, 1), torch.zeros(2, 6, 6, dtype=D)
    axes = (0, 0, 1.0), (0, 1.0, 0), (0, 0, 1.0), (0, 1.0, 0), (1.0, 0, 0)
    chain = Bundle(
        parts=[Part(k + 1, f"{k}", in_capture(bar), motion, covariance) for k, bar in enumerate(bars)],
        joints=[
            joint("revolute", f"{k}", f"{k + 1}", axis, (places[k] + 0.15, 0.0, 0.0), [0.0, 0.7], (0.0, 0.7))
            for k, axis in enumerate(axes)
        ],
        root="0",
        states=["state_00", "state_01"],
    )
    q = {j.name: 0.35 + math.radians(2.4) for j in chain.joints}
    found = fit_configuration(chain, views_of(chain, q), NORMALIZATION)
    assert found.converged
    assert [float(value) for value in found.q.values()] == pytest.approx(list(q.values()), abs=0.05)


def test_a_wrong_joint_fits_worse(cabinet):
    """What the score of a held-out configuration is for: a slide cannot explain a turn."""
    views = views_of(cabinet, {"base_door": 0.6})
    slide = joint("prismatic", "base", "door", (1.0, 0, 0), (0.0, 0, 0), [0.0, 1.0], (0.0, 1.0))
    wrong = Bundle(cabinet.parts, [slide], "base", cabinet.states)
    right = fit_configuration(cabinet, views, NORMALIZATION).residual["door"]
    assert fit_configuration(wrong, views, NORMALIZATION).residual["door"] > 5 * right


def test_a_part_that_no_label_shows_stays_and_is_named(cabinet):
    views = views_of(cabinet, {"base_door": 0.5, "door_knob": 0.5})
    for view in views:
        view.labels[view.labels == 3] = 255
    found = fit_configuration(cabinet, views, NORMALIZATION)
    assert found.unseen == ["knob"]
    assert float(found.q["door_knob"]) == 0
    assert "knob" not in found.residual


def test_a_part_without_gaussians_stays_and_is_named(cabinet):
    views = views_of(cabinet, {"base_door": 0.5, "door_knob": 0.5})
    nothing = cabinet.parts[0].splat.select(torch.tensor([], dtype=torch.long))
    parts = [replace(part, splat=nothing) if part.name == "knob" else part for part in cabinet.parts]
    found = fit_configuration(replace(cabinet, parts=parts), views, NORMALIZATION)
    assert (found.unseen, float(found.q["door_knob"])) == (["knob"], 0)


def test_a_part_that_is_not_seen_is_known_by_what_hangs_on_it(cabinet):
    views = views_of(cabinet, {"base_door": 0.1})
    for view in views:
        view.labels[view.labels == 2] = 255
    found = fit_configuration(cabinet, views, NORMALIZATION)
    assert found.unseen == ["door"]
    assert float(found.q["base_door"]) == pytest.approx(0.1, abs=0.01)


def test_an_object_without_joints_has_no_values(cabinet):
    rigid = Bundle(cabinet.parts, [], "base", cabinet.states)
    found = fit_configuration(rigid, views_of(cabinet, {}), NORMALIZATION)
    assert found.q == {} and found.converged


def test_a_turn_is_looked_for_all_around_and_a_slide_beyond_its_range(cabinet):
    hinge = next(j for j in cabinet.joints if j.type == "revolute")
    turns = sweep_values(hinge).sort().values
    assert float(turns.diff().max()) == pytest.approx(float(turns.diff().min()))
    assert float(turns[-1] - turns[0]) == pytest.approx(2 * math.pi * 71 / 72)
    assert float((turns - 0.35).abs().min()) < 1e-9  # with the middle of the range
    slide = sweep_values(next(j for j in cabinet.joints if j.type == "prismatic"))
    assert (float(slide[0]), float(slide[-1])) == (-1.5, 3.0)
