"""How many digits a function and its gradient keep, against the same function in 60 digits.

The yardstick is what no implementation can avoid: an input that is rounded to the type already moves the exact result.
An error is stated relative to the largest entry of the result, and as a multiple of that unavoidable one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mpmath
import torch
from mpmath import mpf
from torch import Tensor

DIGITS = 60
PERTURBATIONS = 2
"""Draws of rounded inputs; the largest effect counts."""
_STEP = mpf(10) ** -25


@dataclass(frozen=True)
class Case:
    """Where in its domain an operation is tried."""

    at: float
    """The place on the operation's axis."""
    inputs: Sequence[Tensor]
    """Float64; rounded to the type under test before either side sees them."""
    probes: Sequence[tuple[int, int]] | None = None
    """Entries (input, flat index) whose derivative is compared; all of the differentiated inputs by default."""
    exact_gradient: bool = True
    """False where the derivative jumps, as that of a logarithm at pi: it must be finite, no more."""


@dataclass(frozen=True)
class Operation:
    """A function of the package and its twin in many digits."""

    name: str
    axis: str
    """What `Case.at` is, with its unit."""
    function: Callable[..., Sequence[Tensor]]
    """From inputs to groups of outputs; a group's errors are relative to its largest entry."""
    reference: Callable[..., Sequence[Sequence[mpf]]]
    """The same from lists of mpf."""
    cases: Sequence[Case] | Callable[[torch.dtype], Sequence[Case]]
    differentiated: Sequence[int] = ()
    """Which inputs it is differentiated by; none if gradients do not matter."""
    signless: bool = False
    """Whether a group of outputs and its negative mean the same."""
    dtypes: Sequence[torch.dtype] = (torch.float32, torch.float64)
    note: str = ""
    """What the table says besides."""


@dataclass
class Error:
    """A relative error at one place, and the one that rounding the inputs forces."""

    at: float
    relative: float
    forced: float

    @property
    def excess(self) -> float:
        return self.relative / self.forced


@dataclass
class Measurement:
    """All errors of one operation in one type."""

    operation: Operation
    dtype: torch.dtype
    forward: list[Error] = field(default_factory=list)
    gradient: list[Error] = field(default_factory=list)


def measure(operation: Operation, dtype: torch.dtype) -> Measurement:
    """Run all cases; results that are not finite have infinite errors."""
    result = Measurement(operation, dtype)
    with mpmath.workdps(DIGITS):
        cases = operation.cases(dtype) if callable(operation.cases) else operation.cases
        for number, case in enumerate(cases):
            forward, gradient = _measure_case(operation, case, dtype, number)
            result.forward.append(forward)
            if gradient is not None:
                result.gradient.append(gradient)
    return result


def _measure_case(operation: Operation, case: Case, dtype: torch.dtype, seed: int) -> tuple[Error, Error | None]:
    generator = torch.Generator().manual_seed(seed)
    inputs = [x.to(dtype) for x in case.inputs]
    leaves = [x.clone().requires_grad_(i in operation.differentiated) for i, x in enumerate(inputs)]
    outputs = [y.flatten() for y in operation.function(*leaves)]
    exact = [[mpf(v) for v in x.flatten().tolist()] for x in inputs]
    truth = operation.reference(*exact)
    rounded = [_rounded(exact, torch.finfo(dtype).eps, generator) for _ in range(PERTURBATIONS)]
    eps = torch.finfo(dtype).eps

    signs = []
    for found, true in zip(outputs, truth, strict=True):
        opposite = operation.signless and _distance(found, [-v for v in true]) < _distance(found, true)
        signs.append(-1 if opposite else 1)
    # Each group weighs the same in the scalar that is differentiated: it is divided by its largest entry.
    scales = [max(abs(v) for v in group) or mpf(1) for group in truth]
    aligned = [[s * v for v in group] for s, group in zip(signs, truth, strict=True)]
    moved = [operation.reference(*x) for x in rounded]
    relative = max(float(_distance(y, t) / s) for y, t, s in zip(outputs, aligned, scales, strict=True))
    forced = max(
        float(max(abs(a - b) for a, b in zip(group, true, strict=True)) / s)
        for groups in moved
        for group, true, s in zip(groups, truth, scales, strict=True)
    )
    forward = Error(case.at, relative, max(forced, eps))
    if not operation.differentiated:
        return forward, None

    weights = [torch.randn(len(y), generator=generator, dtype=torch.float64) for y in outputs]
    loss = sum((w.to(y) / float(s) * y).sum() for w, y, s in zip(weights, outputs, scales, strict=True))
    gradients = torch.autograd.grad(loss, [leaves[i] for i in operation.differentiated])
    if not all(g.isfinite().all() for g in gradients):
        return forward, Error(case.at, math.inf, eps)
    if not case.exact_gradient:
        return forward, None

    def functional(values: list[list[mpf]]) -> mpf:
        groups = operation.reference(*values)
        return mpmath.fsum(
            mpf(float(w.to(dtype) / float(s))) * v * sign
            for ws, s, group, sign in zip(weights, scales, groups, signs, strict=True)
            for w, v in zip(ws, group, strict=True)
        )

    probes = case.probes or [(i, k) for i in operation.differentiated for k in range(inputs[i].numel())]
    found = dict(zip(operation.differentiated, gradients, strict=True))
    units = [max(abs(v) for v in x) or mpf(1) for x in exact]
    # Per share of an input's largest entry, so that derivatives by all inputs compare.
    true = {(i, k): units[i] * _derivative(functional, exact, i, k) for i, k in probes}
    size = max(abs(v) for v in true.values()) or mpf(1)
    relative, forced = 0.0, eps
    for (i, k), derivative in true.items():
        relative = max(relative, float(abs(units[i] * mpf(found[i].flatten()[k].item()) - derivative) / size))
        other = units[i] * _derivative(functional, rounded[0], i, k)
        forced = max(forced, float(abs(other - derivative) / size))
    return forward, Error(case.at, relative, forced)


def _rounded(values: list[list[mpf]], eps: float, generator: torch.Generator) -> list[list[mpf]]:
    """The inputs, each moved by half a unit in the last place, up or down."""
    signs = [torch.randint(2, (len(x),), generator=generator).mul(2).sub(1).tolist() for x in values]
    return [
        [v * (1 + mpf(eps) / 2 * s) for v, s in zip(x, ss, strict=True)] for x, ss in zip(values, signs, strict=True)
    ]


def _distance(found: Tensor, true: Sequence[mpf]) -> mpf:
    """The largest difference; infinite if something is not finite."""
    if not found.isfinite().all():
        return mpf("inf")
    return max((abs(mpf(a) - b) for a, b in zip(found.tolist(), true, strict=True)), default=mpf(0))


def _derivative(functional: Callable[[list[list[mpf]]], mpf], values: list[list[mpf]], index: int, entry: int) -> mpf:
    """By a central difference whose error is beyond all digits that count."""
    step = _STEP * max([abs(v) for v in values[index]] + [mpf(1e-8)])
    ends = []
    for sign in (1, -1):
        moved = list(values)
        moved[index] = list(values[index])
        moved[index][entry] += sign * step
        ends.append(functional(moved))
    return (ends[0] - ends[1]) / (2 * step)
