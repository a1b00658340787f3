"""What docs/numerics.md reports, held to bounds at a few places of every domain."""

import math
from dataclasses import replace

import pytest
import torch
from geometry_operations import GEOMETRY
from image_operations import IMAGES
from joint_fits import TYPES, fit_error
from joint_operations import JOINTS
from numerics import KEPT, LOST, place
from pages import markdown
from precision import Case, Operation, measure

BOUNDS = {
    "screw from motion and back": 1e4,  # it drops turns that are lost in rounding
    "L1 + SSIM loss": 1e5,  # its value is a difference to 1
}
"""Multiples of the forced error; where none is named, `KEPT` and for long chains of operations `LOST`."""
LONG = ("rotation of spherical harmonics", "forward kinematics", "compositing")


def thinned(operation, dtype):
    """With a few of its cases, the ends among them."""
    cases = operation.cases(dtype) if callable(operation.cases) else operation.cases
    cases = [case for case in cases if not ("deep" in operation.name and case.at > 100)]
    cases = [*cases[: -1 : max(1, len(cases) // 3)], cases[-1]]
    return replace(operation, cases=[replace(case, probes=case.probes and case.probes[::2]) for case in cases])


@pytest.mark.parametrize("operation", [*GEOMETRY, *IMAGES, *JOINTS], ids=lambda operation: operation.name)
def test_an_operation_keeps_the_digits_that_its_inputs_have(operation):
    for dtype in operation.dtypes:
        measured = measure(thinned(operation, dtype), dtype)
        errors = measured.forward + measured.gradient
        assert all(math.isfinite(e.relative) for e in errors)
        allowed = BOUNDS.get(operation.name, LOST if operation.name.startswith(LONG) else KEPT)
        assert max(e.excess for e in errors) <= allowed


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("travel", [1e-9, 1e-3, math.pi])
def test_joint_fits_are_as_exact_as_the_motions(kind, travel):
    error = fit_error(kind, travel)
    assert error.converged and error.residual < 1e-14 and error.axis < 20 * error.forced


def test_a_loss_of_digits_is_seen():
    """1 - cos x of a small angle, in the form that cancels and in the one that does not."""

    def operation(function):
        from mpmath import cos

        cases = [Case(1e-3, (torch.tensor([1e-3], dtype=torch.float64),))]
        return Operation("1 - cos", "rad", function, lambda x: [[1 - cos(x[0])]], cases, differentiated=(0,))

    cancelling = measure(operation(lambda x: [1 - x.cos()]), torch.float32)
    stable = measure(operation(lambda x: [2 * (x / 2).sin().square()]), torch.float32)
    assert cancelling.forward[0].excess > 1e3 and cancelling.gradient[0].excess < 3
    assert stable.forward[0].excess < 3 and stable.gradient[0].excess < 3


def test_a_result_that_is_not_finite_is_an_infinite_error():
    case = Case(0.0, (torch.zeros(1, dtype=torch.float64),))
    operation = Operation("sqrt", "x", lambda x: [x.sqrt()], lambda x: [[x[0]]], [case], differentiated=(0,))
    measured = measure(operation, torch.float64)
    assert math.isinf(measured.gradient[0].excess) and measured.forward[0].relative == 0


def test_tables_and_places_read_well():
    assert markdown(("a", "b"), [("1", "2")]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    assert [place(x) for x in (0.0, 1e-12, 0.5, 1e8, math.pi - 1e-9, math.pi)] == [
        "0",
        "1e-12",
        "0.5",
        "1e8",
        "π - 1e-9",
        "π",
    ]
