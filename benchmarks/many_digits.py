"""Rotations, motions and spherical harmonics with mpmath's numbers: what the package's functions are held to.

Written from the definitions, not after the package's code: slow and plain. Vectors are lists, matrices lists of rows.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import mpmath
from mpmath import mpf

Vector = list[mpf]
Matrix = list[Vector]


def matmul(A: Matrix, B: Matrix) -> Matrix:
    columns = list(zip(*B, strict=True))
    return [[sum(a * b for a, b in zip(row, column, strict=True)) for column in columns] for row in A]


def apply(A: Matrix, x: Sequence[mpf]) -> Vector:
    return [sum(a * b for a, b in zip(row, x, strict=True)) for row in A]


def transpose(A: Matrix) -> Matrix:
    return [list(column) for column in zip(*A, strict=True)]


def flat(A: Matrix) -> Vector:
    return [v for row in A for v in row]


def rows(values: Sequence[mpf], width: int) -> Matrix:
    return [list(values[i : i + width]) for i in range(0, len(values), width)]


def norm(x: Sequence[mpf]) -> mpf:
    return mpmath.sqrt(sum(v * v for v in x))


def cross(a: Sequence[mpf], b: Sequence[mpf]) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def skew(v: Sequence[mpf]) -> Matrix:
    x, y, z = v
    return [[mpf(0), -z, y], [z, mpf(0), -x], [-y, x, mpf(0)]]


def solve(A: Matrix, b: Sequence[mpf]) -> Vector:
    return list(mpmath.lu_solve(mpmath.matrix(A), mpmath.matrix(list(b))))


def _coefficients(angle: mpf) -> tuple[mpf, mpf, mpf]:
    """sin(x) / x, (1 - cos(x)) / x^2 and (x - sin(x)) / x^3."""
    if angle < mpf(10) ** -12:  # by their series, whose next terms are beyond 60 digits or harmless
        x2 = angle * angle
        return tuple(sum((-x2) ** k / mpmath.factorial(2 * k + n) for k in range(6)) for n in (1, 2, 3))  # type: ignore[return-value]
    s, c = mpmath.sin(angle), mpmath.cos(angle)
    return s / angle, (1 - c) / angle**2, (angle - s) / angle**3


def _series(phi: Sequence[mpf], first: mpf, second: mpf) -> Matrix:
    """1 + first K + second K^2."""
    K = skew(phi)
    KK = matmul(K, K)
    return [[mpf(i == j) + first * K[i][j] + second * KK[i][j] for j in range(3)] for i in range(3)]


def rotation(phi: Sequence[mpf]) -> Matrix:
    """Rodrigues' formula."""
    a, b, _ = _coefficients(norm(phi))
    return _series(phi, a, b)


def left_jacobian(phi: Sequence[mpf]) -> Matrix:
    _, b, c = _coefficients(norm(phi))
    return _series(phi, b, c)


def motion(xi: Sequence[mpf]) -> Matrix:
    """The upper rows [3][4] of the exponential of a tangent (translation, rotation)."""
    R, t = rotation(xi[3:]), apply(left_jacobian(xi[3:]), xi[:3])
    return [[*row, v] for row, v in zip(R, t, strict=True)]


def compose(A: Matrix, B: Matrix) -> Matrix:
    """Of the upper rows of two motions."""
    bottom = [[mpf(0), mpf(0), mpf(0), mpf(1)]]
    return matmul(A, [*B, *bottom])


def nearest_rotation(R: Matrix) -> Matrix:
    """The orthogonal matrix next to one that is nearly so, by Newton's iteration of the polar decomposition."""
    X = mpmath.matrix(R)
    for _ in range(5):
        X = (X + (X**-1).T) / 2
    return [[X[i, j] for j in range(3)] for i in range(3)]


def quaternion(R: Matrix) -> Vector:
    """wxyz, w >= 0, from the largest of its components."""
    w = 1 + R[0][0] + R[1][1] + R[2][2]
    squares = [w] + [1 + 2 * R[i][i] - (R[0][0] + R[1][1] + R[2][2]) for i in range(3)]  # 4 q_i^2
    largest = max(range(4), key=lambda i: squares[i])
    if largest == 0:
        q = [w, R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = [mpf(0)] * 4
        q[0], q[1 + i] = R[k][j] - R[j][k], squares[largest]
        q[1 + j], q[1 + k] = R[i][j] + R[j][i], R[i][k] + R[k][i]
    length = norm(q) * (-1 if q[0] < 0 else 1)
    return [v / length for v in q]


def rotation_vector(R: Matrix) -> Vector:
    w, *v = quaternion(R)
    sine = norm(v)
    if sine == 0:
        return [mpf(0)] * 3
    return [2 * mpmath.atan2(sine, w) * x / sine for x in v]


def tangent(T: Matrix) -> Vector:
    """The logarithm of the upper rows of a motion."""
    phi = rotation_vector([row[:3] for row in T])
    return [*solve(left_jacobian(phi), [row[3] for row in T]), *phi]


def matrix_of_quaternion(q: Sequence[mpf]) -> Matrix:
    length = norm(q)
    w, x, y, z = (v / length for v in q)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def sh_basis(d: Sequence[mpf]) -> Vector:
    """Real spherical harmonics to degree 3 at a unit direction, from Legendre functions; odd orders negated."""
    x, y, z = d
    plane = [(mpf(1), mpf(0))]  # real and imaginary part of (x + iy)^m
    for _ in range(3):
        re, im = plane[-1]
        plane.append((re * x - im * y, re * y + im * x))
    # P_l^m(z) / (1 - z^2)^(m / 2) without the Condon-Shortley phase.
    legendre = {(0, 0): mpf(1), (1, 0): z, (1, 1): mpf(1), (2, 0): (3 * z * z - 1) / 2, (2, 1): 3 * z, (2, 2): mpf(3)}
    legendre |= {(3, 0): (5 * z**3 - 3 * z) / 2, (3, 1): (15 * z * z - 3) / 2, (3, 2): 15 * z, (3, 3): mpf(15)}
    values = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            m = abs(order)
            values.append(_sh_scale(degree, m) * legendre[degree, m] * plane[m][order < 0])
    return values


@functools.cache
def _sh_scale(degree: int, order: int) -> mpf:
    scale = mpf(2 * degree + 1) / (4 * mpmath.pi) * (1 if order == 0 else 2)
    scale *= mpmath.factorial(degree - order) / mpmath.factorial(degree + order)
    return mpmath.sqrt(scale) * (-1) ** order


def directions(count: int) -> Matrix:
    """Unit vectors in general position."""
    out = []
    for k in range(count):
        v = [mpmath.cos(3 * k + 1), mpmath.sin(5 * k + 2), mpmath.cos(7 * k * k + 3)]
        length = norm(v)
        out.append([x / length for x in v])
    return out
