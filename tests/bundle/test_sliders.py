import math
from dataclasses import replace

import pytest
import torch

from splatart_ns.bundle.sliders import bundle_sliders, configuration, positions, slider_range


@pytest.mark.parametrize(("low", "high"), [(0.0, 34.4), (-0.25, 0.0), (0.0, 1e-12), (-1500.0, 2500.0), (10.0, 11.0)])
def test_a_sliders_range_holds_what_was_observed_in_round_steps(low: float, high: float) -> None:
    start, end, step = slider_range(low, high)
    assert start <= low - 0.5 * (high - low) and end >= high + 0.5 * (high - low)
    assert 100 <= (end - start) / step <= 1002
    assert math.log10(step) == pytest.approx(round(math.log10(step)))


def test_one_slider_a_freedom_with_unit_and_limits(bundle):
    hinge, slide = bundle_sliders(bundle)
    assert (hinge.label, slide.label) == ("hinge (degree)", "slide (metre)")
    assert hinge.ends == pytest.approx((0, 90)) and slide.ends == pytest.approx((-0.25, 0))
    assert hinge.low <= -45 and hinge.high >= 135


def test_a_round_part_whose_turns_nothing_tells_can_be_turned_all_round(bundle):
    told = bundle_sliders(bundle)[0]
    bundle.joints[1] = replace(bundle.joints[1], values=0 * bundle.joints[1].values, limits=(-math.pi, math.pi))
    hinge = bundle_sliders(bundle)[0]
    assert hinge.ends == pytest.approx((-180, 180)) and hinge.low <= -180 and hinge.high >= 180
    assert (told.note, hinge.note) == ("range 0 to 90 degree", "nothing tells how far it turned")


def test_a_length_of_unknown_unit_is_called_a_length(bundle):
    bundle.length_unit = "unknown"
    assert bundle_sliders(bundle)[1].label == "slide (length)"


def test_positions_are_degrees_and_lengths_and_come_back(bundle):
    sliders = bundle_sliders(bundle)
    q = configuration(sliders, [30.0, -0.1])
    assert q == pytest.approx({"hinge": math.radians(30), "slide": -0.1})
    assert positions(sliders, q) == pytest.approx([30.0, -0.1])
    assert positions(sliders, {"slide": 0.2}) == pytest.approx([0.0, 0.2])


@pytest.mark.parametrize(
    ("kind", "value", "shown", "labels"),
    [
        ("cylindrical", [0.5, 0.1], [0.5, math.degrees(0.1)], ["slide", "turn"]),
        ("spherical", [0.1, -0.2, 0.3], [math.degrees(x) for x in (0.1, -0.2, 0.3)], ["turn x", "turn y", "turn z"]),
        ("free", [1.0, 2, 3, 0, 0, 0.1], [1, 2, 3, 0, 0, math.degrees(0.1)], ["x", "y", "z", "turn x"]),
    ],
)
def test_a_joint_of_several_freedoms_has_as_many_sliders(bundle, kind, value, shown, labels):
    values = torch.tensor([[0.0] * len(value), value], dtype=torch.float64)
    bundle.joints[1] = replace(bundle.joints[1], type=kind, values=values, limits=None)
    sliders = [slider for slider in bundle_sliders(bundle) if slider.joint == "hinge"]
    assert [s.label.removeprefix("hinge ").rpartition(" (")[0] for s in sliders][: len(labels)] == labels
    assert positions(sliders, {"hinge": value}) == pytest.approx(shown)
    assert configuration(sliders, shown)["hinge"] == pytest.approx(value)


def test_limits_that_somebody_edited_are_the_range_whatever_was_observed(bundle):
    bundle.joints[1].limits = (0.0, 0.3)
    hinge = bundle_sliders(bundle)[0]
    assert hinge.ends == pytest.approx((0, math.degrees(0.3))) and hinge.note == "range 0 to 17.19 degree"


def test_limits_that_lack_state_0_by_rounding_are_widened_to_it(bundle):
    bundle.joints[1].limits = (1e-7, 1.0)
    hinge = bundle_sliders(bundle)[0]
    assert hinge.ends[0] == 0 and hinge.low <= 0
