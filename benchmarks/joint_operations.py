"""Joints and chains of them, beside their definitions in many digits."""

from __future__ import annotations

from collections.abc import Sequence

import many_digits as md
import torch
from domains import ANGLES, AXES, tensor
from mpmath import mpf
from precision import Case, Operation
from torch import Tensor

from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics
from splatart_ns.stages.joint_fit import JointFit, mean_distance
from splatart_ns.stages.joint_parameters import JOINT_DOFS, joint_motion

ORIGIN, PITCH = (0.4, -0.3, 0.2), 0.15


def exact_joint(kind: str, values: Sequence[mpf]) -> md.Matrix:
    axis = [mpf(a) for a in AXES[0]]
    axis = [a / md.norm(axis) for a in axis]
    if kind == "free":
        return md.motion(values)
    phi, slide = [mpf(0)] * 3, mpf(0)
    if kind == "spherical":
        phi = list(values)
    elif kind == "prismatic":
        slide = values[0]
    elif kind != "fixed":
        phi = [values[-1] * a for a in axis]
        slide = {"screw": mpf(PITCH) * values[-1], "cylindrical": values[0]}.get(kind, mpf(0))
    R = md.rotation(phi)
    turned = md.apply(R, [mpf(v) for v in ORIGIN])
    return [[*row, mpf(o) - q + slide * a] for row, o, q, a in zip(R, ORIGIN, turned, axis, strict=True)]


def unit_axis(like: Tensor) -> Tensor:
    axis = tensor(*AXES[0])
    return (axis / axis.norm()).to(like)


def joint_operation(kind: str) -> Operation:
    dofs = JOINT_DOFS[kind]

    def function(values: Tensor) -> list[Tensor]:
        at = values[0] if dofs == 1 else values
        return [joint_motion(kind, unit_axis(values), tensor(*ORIGIN).to(values), PITCH, at)[:3]]

    spread = torch.linspace(1, 0.4, dofs, dtype=torch.float64)
    return Operation(
        f"motion of a {kind} joint",
        "value",
        function,
        lambda values: [md.flat(exact_joint(kind, values))],
        [Case(angle, (angle * spread / spread.norm(),)) for angle in ANGLES],
        differentiated=(0,),
    )


CHAIN = 30


def chain() -> KinematicTree:
    kinds = ("revolute", "prismatic", "screw")
    fits = [
        JointFit(kinds[k % 3], unit_axis(tensor(0.0)), tensor(*ORIGIN), PITCH if k % 3 == 2 else 0.0, tensor(0, 1), 0.0)
        for k in range(CHAIN)
    ]
    return KinematicTree(list(range(1, CHAIN + 2)), 1, [Joint(k + 1, k + 2, fit) for k, fit in enumerate(fits)])


def exact_chain(q: Sequence[mpf]) -> list[list[mpf]]:
    T = [[mpf(i == j) for j in range(4)] for i in range(3)]
    for k, value in enumerate(q):
        T = md.compose(T, exact_joint(("revolute", "prismatic", "screw")[k % 3], [value]))
    return [md.flat(T)]


POINTS = torch.rand(8, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5


def top_rows(value: float) -> Tensor:
    """Of a revolute joint's motion [12]."""
    return joint_motion("revolute", unit_axis(tensor(0.0)), tensor(*ORIGIN), 0.0, torch.tensor(value).double())[
        :3
    ].flatten()


def distance(a: Tensor, b: Tensor) -> list[Tensor]:
    T = torch.stack([torch.cat([x, x.new_tensor([0, 0, 0, 1])]).reshape(1, 4, 4) for x in (a, b)])
    return [torch.tensor([mean_distance(POINTS.to(T), *T)], dtype=a.dtype)]


def exact_distance(a: Sequence[mpf], b: Sequence[mpf]) -> list[list[mpf]]:
    D = md.rows([x - y for x, y in zip(a, b, strict=True)], 4)
    distances = [md.norm(md.apply(D, [mpf(v) for v in (*point, 1.0)])) for point in POINTS.tolist()]
    return [[sum(distances) / len(distances)]]


JOINTS = [
    *(joint_operation(kind) for kind in ("revolute", "prismatic", "screw", "cylindrical", "spherical", "free")),
    Operation(
        f"forward kinematics, {CHAIN} joints in a row",
        "value of each joint",
        lambda q: [forward_kinematics(chain(), q)[-1, :3]],
        exact_chain,
        [
            Case(a, (torch.full((CHAIN,), a, dtype=torch.float64),), probes=[(0, k) for k in (0, 11, 29)])
            for a in ANGLES
        ],
        differentiated=(0,),
    ),
    Operation(
        "mean distance of points (ADD)",
        "angle between the motions, rad",
        distance,
        exact_distance,
        [Case(a, (top_rows(0.3), top_rows(0.3 + a))) for a in ANGLES if a > 0],
    ),
]
