"""Rotations, motions, screws and spherical harmonics, each beside its definition in many digits.

Inverses of the exponentials take a matrix that is rounded to the type, times the exponential of a tangent that is 0: so
that the exponential's own errors do not count, and derivatives are those along the group.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import many_digits as md
import mpmath
import torch
from domains import ANGLES, AXES, SCALES, intrinsics, numbers, tensor
from mpmath import mpf
from precision import Case, Operation
from torch import Tensor

from splatart_ns.geometry import se3
from splatart_ns.geometry.camera import project_points
from splatart_ns.geometry.screw import screw_from_motion
from splatart_ns.geometry.spherical_harmonics import rotate_sh


def below_pi(angle: float, dtype: torch.dtype) -> bool:
    """Whether the type can tell an angle from pi."""
    return angle < math.pi - 30 * torch.finfo(dtype).eps


def turned(angle: float, axis: Sequence[float]) -> Tensor:
    with mpmath.workdps(40):
        R = md.rotation([mpf(angle) * mpf(a) for a in axis])
        return tensor(*map(float, md.flat(R)))


def rotation_cases(function_of: Callable[[float, Sequence[float]], tuple]) -> Callable[[torch.dtype], list[Case]]:
    def cases(dtype: torch.dtype) -> list[Case]:
        return [
            Case(angle, function_of(angle, axis), exact_gradient=below_pi(angle, dtype))
            for angle in ANGLES
            for axis in AXES
        ]

    return cases


def at_rotation(function: Callable[[Tensor], Sequence[Tensor]]) -> Callable[[Tensor, Tensor], Sequence[Tensor]]:
    return lambda R, d: function(R.reshape(3, 3) @ se3.so3_exp(d))


def exact_rotation(R: Sequence[mpf], d: Sequence[mpf]) -> md.Matrix:
    return md.matmul(md.nearest_rotation(md.rows(R, 3)), md.rotation(d))


def at_motion(function: Callable[[Tensor], Sequence[Tensor]]) -> Callable[..., Sequence[Tensor]]:
    def moved(R: Tensor, t: Tensor, d: Tensor) -> Sequence[Tensor]:
        return function(se3.from_rotation_translation(R.reshape(3, 3), t) @ se3.se3_exp(d))

    return moved


def exact_motion(R: Sequence[mpf], t: Sequence[mpf], d: Sequence[mpf]) -> md.Matrix:
    top = md.nearest_rotation(md.rows(R, 3))
    return md.compose([[*row, v] for row, v in zip(top, t, strict=True)], md.motion(d))


def exact_screw(R: Sequence[mpf], t: Sequence[mpf], d: Sequence[mpf]) -> list[list[mpf]]:
    T = exact_motion(R, t, d)
    phi, t = md.rotation_vector([row[:3] for row in T]), [row[3] for row in T]
    angle = md.norm(phi)
    axis = [v / angle for v in phi]
    slide = sum(a * b for a, b in zip(axis, t, strict=True))
    across = [v - slide * a for v, a in zip(t, axis, strict=True)]
    turned = md.cross(axis, across)
    point = [a / 2 + b / (2 * mpmath.tan(angle / 2)) for a, b in zip(across, turned, strict=True)]
    return [point, [angle], [slide * a for a in axis], [a * b for a in axis for b in axis]]


def screw_outputs(T: Tensor) -> list[Tensor]:
    screw = screw_from_motion(T, torch.zeros(3).to(T))
    outer = screw.axis[:, None] * screw.axis
    return [screw.point, screw.angle, screw.slide * screw.axis, outer]


def screw_cases(dtype: torch.dtype) -> list[Case]:
    """From the angle on that `screw_from_motion` takes for a turn."""
    least = 10 * torch.finfo(dtype).eps ** 0.75
    cases = rotation_cases(lambda angle, axis: (turned(angle, axis), tensor(0.3, -0.2, 0.5), torch.zeros(6).double()))
    return [case for case in cases(dtype) if case.at > least]


GEOMETRY = [
    Operation(
        "SO(3) exp",
        "angle, rad",
        lambda phi: [se3.so3_exp(phi)],
        lambda phi: [md.flat(md.rotation(phi))],
        rotation_cases(lambda angle, axis: (angle * tensor(*axis),)),
        differentiated=(0,),
    ),
    Operation(
        "SO(3) log",
        "angle, rad",
        at_rotation(lambda R: [se3.so3_log(R)]),
        lambda R, d: [md.rotation_vector(exact_rotation(R, d))],
        rotation_cases(lambda angle, axis: (turned(angle, axis), torch.zeros(3).double())),
        differentiated=(1,),
        signless=True,
    ),
    Operation(
        "SE(3) exp",
        "angle, rad",
        lambda xi: [se3.se3_exp(xi)[:3, :3], se3.se3_exp(xi)[:3, 3]],
        lambda xi: [md.flat([row[:3] for row in md.motion(xi)]), [row[3] for row in md.motion(xi)]],
        rotation_cases(lambda angle, axis: (torch.cat([tensor(0.3, -0.2, 0.5), angle * tensor(*axis)]),)),
        differentiated=(0,),
    ),
    Operation(
        "SE(3) log",
        "angle, rad",
        at_motion(lambda T: [se3.se3_log(T)[:3], se3.se3_log(T)[3:]]),
        lambda R, t, d: [md.tangent(exact_motion(R, t, d))[:3], md.tangent(exact_motion(R, t, d))[3:]],
        lambda dtype: [
            Case(angle, (turned(angle, axis), tensor(0.3, -0.2, 0.5), torch.zeros(6).double()))
            for angle in ANGLES
            for axis in AXES
            if below_pi(angle, dtype)
        ],
        differentiated=(2,),
        note="at pi, where the logarithm jumps, only that it is finite and comes back (tests)",
    ),
    Operation(
        "screw from motion",
        "angle, rad",
        at_motion(screw_outputs),
        exact_screw,
        screw_cases,
        differentiated=(2,),
        signless=True,
        note="the line's distance is t / angle: its digits go with the angle's",
    ),
    Operation(
        "screw from motion and back",
        "angle, rad",
        at_motion(lambda T: [screw_from_motion(T, torch.zeros(3).to(T)).motion()[:3]]),
        lambda R, t, d: [md.flat(exact_motion(R, t, d))],
        rotation_cases(lambda angle, axis: (turned(angle, axis), tensor(0.3, -0.2, 0.5), torch.zeros(6).double())),
        note="turns up to eps^0.75 count as rounding and are left out, which is the whole error; there is no gradient "
        "to keep: through a line at t / angle it loses as many digits as the angle has zeros",
    ),
    Operation(
        "matrix to quaternion",
        "angle, rad",
        at_rotation(lambda R: [se3.quat_from_matrix(R)]),
        lambda R, d: [md.quaternion(exact_rotation(R, d))],
        rotation_cases(lambda angle, axis: (turned(angle, axis), torch.zeros(3).double())),
        differentiated=(1,),
        signless=True,
    ),
    Operation(
        "quaternion to matrix",
        "norm",
        lambda q: [se3.matrix_from_quat(q)],
        lambda q: [md.flat(md.matrix_of_quaternion(q))],
        [Case(s, (s * tensor(*q),)) for s in (1e-25, *SCALES, 1e25) for q in ((0.1, 0.7, -0.4, 0.6), (1, 0, 0, 0))],
        differentiated=(0,),
    ),
    Operation(
        "projection of points",
        "depth / focal distance",
        lambda x: [project_points(x[None], torch.eye(4).to(x), intrinsics(x))[0]],
        lambda x: [[50 * x[0] / x[2] + 22, 48 * x[1] / x[2] + 18]],
        [Case(z, (tensor(0.3 * z, -0.2 * z, z),)) for z in SCALES],
        differentiated=(0,),
    ),
    Operation(
        "rotation of spherical harmonics",
        "angle, rad",
        lambda sh, phi: [rotate_sh(se3.so3_exp(phi), sh.reshape(1, 16, 1))],
        lambda sh, phi: [rotated_sh(sh, md.rotation(phi))],
        [
            Case(angle, (numbers(16, 1), angle * tensor(*AXES[0])), probes=[(0, 2), (0, 5), (0, 12), (1, 0), (1, 2)])
            for angle in ANGLES
        ],
        differentiated=(0, 1),
    ),
]


def rotated_sh(sh: Sequence[mpf], R: md.Matrix) -> list[mpf]:
    """A band's coefficients c' with basis(d) c' = basis(R^T d) c for as many directions as it has functions."""
    out = [sh[0]]
    for degree in (1, 2, 3):
        band = slice(degree**2, (degree + 1) ** 2)
        dirs, from_values = band_directions(degree)
        seen = [md.sh_basis(md.apply(md.transpose(R), d))[band] for d in dirs]
        out += md.apply(from_values, md.apply(seen, sh[band]))
    return out


@functools.cache
def band_directions(degree: int) -> tuple[md.Matrix, md.Matrix]:
    """Directions, and what takes a band's values there to its coefficients."""
    band, dirs = slice(degree**2, (degree + 1) ** 2), md.directions(2 * degree + 1)
    inverse = mpmath.matrix([md.sh_basis(d)[band] for d in dirs]) ** -1
    return dirs, [list(map(mpf, row)) for row in inverse.tolist()]
