"""Joints with known truth whose observed motions err as their stated covariances say: for tests and the benchmark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.stats import chi2
from torch import Tensor
from torch.nn.functional import normalize

from splatart_ns.bundle import Joint
from splatart_ns.evaluation.joints import axis_angle, covers, point_to_line
from splatart_ns.geometry.se3 import adjoint, from_rotation_translation, inverse, se3_exp
from splatart_ns.stages.articulate import Joint as TreeJoint
from splatart_ns.stages.articulate import KinematicTree, forward_kinematics
from splatart_ns.stages.joint import fit_joints, surface_noise
from splatart_ns.stages.joint_fit import JointFit
from splatart_ns.stages.joint_parameters import joint_motion
from splatart_ns.stages.tree import object_radius

D = torch.float64


@dataclass
class JointCase:
    """A child part and its true joint, in an object of radius 1."""

    kind: str
    points: Tensor
    """Of the child [N, 3]."""
    axis: Tensor
    origin: Tensor
    values: Tensor
    """As in `JointFit`, 0 at state 0."""
    noise: float = 0.003
    """Registration error of the surface, in radii: told to the fit."""
    covariance: Tensor | None = None
    """More error of the motions [S, 6, 6], about the child's centroid where it is at the state: told to the fit."""
    pitch: float = 0.0

    def truth(self) -> Tensor:
        return joint_motion(self.kind, self.axis, self.origin, self.pitch, self.values)

    def _arrived(self) -> Tensor:
        """Frames [S, 4, 4] with the world's directions about the child's centroid at each state."""
        centroids = torch.einsum(
            "sij,j->si", self.truth()[:, :3], torch.cat([self.points.mean(0), torch.ones(1, dtype=D)])
        )
        return from_rotation_translation(torch.eye(3, dtype=D), centroids)

    def observed(self, generator: torch.Generator) -> Tensor:
        """Motions [S, 4, 4] with a draw of their errors."""
        T, S = self.truth(), len(self.values)
        about = from_rotation_translation(torch.eye(3, dtype=D), self.points.mean(0))
        C = surface_noise(self.points, self.noise, 1.0)
        error = about @ se3_exp(_draws(C.expand(S, 6, 6), generator)) @ inverse(about)
        moved = T @ error
        if self.covariance is not None:
            at = self._arrived()
            moved = at @ se3_exp(_draws(self.covariance, generator)) @ inverse(at) @ moved
        return torch.cat([T[:1], moved[1:]])

    def stated(self) -> Tensor:
        """The covariances [S, 6, 6] about the world's origin, as `fit_joint` takes them."""
        if self.covariance is None:
            return torch.zeros(len(self.values), 6, 6, dtype=D)
        to_world = adjoint(self._arrived())
        return to_world @ self.covariance @ to_world.mT


def _draws(C: Tensor, generator: torch.Generator) -> Tensor:
    """A tangent [..., 6] for each covariance; where one is not finite, of unit variance."""
    finite = C.isfinite().all(-1).all(-1)[..., None, None]
    variances, directions = torch.linalg.eigh(torch.where(finite, C, torch.eye(6, dtype=D)))
    z = torch.randn(C.shape[:-1], generator=generator, dtype=D)
    return (directions @ (variances.clamp_min(0).sqrt() * z)[..., None])[..., 0]


@dataclass(frozen=True)
class JointErrors:
    """How far one fit is from the truth."""

    type: str
    ambiguous: bool
    undetermined: bool
    """Whether the fit says that something is."""
    axis: float
    """Degrees; NaN where truth or fit has no axis."""
    position: float
    """Distance of the true origin from the fitted line or centre, in radii; NaN where there is none."""
    value: float
    """Largest difference of the values, radian or length; NaN where the types differ."""
    axis_covered: bool | None
    """Whether the 95 % region of axes holds the true one."""
    values_covered: bool | None


def fit_cases(cases: Sequence[JointCase], seed: int = 0, types: Sequence[str] | None = None) -> list[JointFit]:
    """Fits of cases of the same number of states and the same noise."""
    generator = torch.Generator().manual_seed(seed)
    T = torch.stack([case.observed(generator) for case in cases])
    stated = torch.stack([case.stated() for case in cases])
    return fit_joints(T, [case.points for case in cases], 1.0, stated, cases[0].noise, types=types)


def joint_errors(case: JointCase, fit: JointFit) -> JointErrors:
    same = fit.type == case.kind
    has_axis = "fixed" not in (fit.type, case.kind) and "spherical" not in (fit.type, case.kind)
    lines = has_axis and "prismatic" not in (fit.type, case.kind)
    position = point_to_line(case.origin, fit.axis, fit.origin) if lines else math.nan
    if case.kind == fit.type == "spherical":
        position = float(torch.linalg.vector_norm(fit.origin - case.origin))
    value, values_covered, axis_covered = math.nan, None, None
    if same and case.kind != "fixed":
        truth = case.values if case.kind == "spherical" or float(fit.axis @ case.axis) > 0 else -case.values
        error = (fit.values - truth)[1:].flatten()
        if case.kind == "revolute":
            error = torch.remainder(error + math.pi, 2 * math.pi) - math.pi
        value = float(error.abs().max())
        C = torch.tensor(fit.covariance["values"], dtype=D)
        skip = len(C) - len(error)
        distance2 = float(error @ torch.linalg.solve(C[skip:, skip:], error))
        values_covered = distance2 <= chi2.ppf(0.95, len(error))
        joint = Joint("", fit.type, "", "", fit.axis, fit.origin, fit.values, fit.limits, covariance=fit.covariance)
        axis_covered = covers(joint, case.axis, case.origin)
    return JointErrors(
        type=fit.type,
        ambiguous=fit.ambiguous,
        undetermined=bool(fit.undetermined),
        axis=axis_angle(fit.axis, case.axis) if has_axis else math.nan,
        position=position,
        value=value,
        axis_covered=axis_covered,
        values_covered=values_covered,
    )


def random_case(seed: int, kind: str, states: int, *, covariance: bool = True, noise: float = 1e-3) -> JointCase:
    """A box-shaped part on a joint of random place, direction, travel and (if asked) covariances."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=D)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=D)

    points = (normal(300, 3).clamp(-1.5, 1.5) * uniform(0.1, 0.3, 3)) + 0.4 * normal(3)
    travel = {"prismatic": 0.4, "fixed": 0.0}.get(kind, 1.2)
    dofs = {"cylindrical": (2,), "spherical": (3,)}.get(kind, ())
    values = uniform(0.3, 1.0, states, *dofs) * travel * uniform(-1, 1, states, *dofs).sign()
    values[0] = 0
    C = None
    if covariance:
        # Long and short axes over two decades: translations of 0.001 to 0.01 radii, turns of 0.1 to 1.5 degrees.
        spread = normal(states, 6, 6)
        directions = torch.linalg.eigh(spread + spread.mT).eigenvectors
        sigma = 10 ** uniform(-3.0, -1.6, states, 6)
        C = directions @ torch.diag_embed(sigma**2) @ directions.mT
    return JointCase(
        kind, points, normalize(normal(3), dim=0), points.mean(0) + 0.3 * normal(3), values, noise, C, pitch=0.1
    )


Z, X = torch.tensor([0.0, 0, 1], dtype=D), torch.tensor([1.0, 0, 0], dtype=D)


def _box(seed: int) -> Tensor:
    return random_case(seed, "fixed", 2).points


def _values(kind: str, *values: float) -> Tensor:
    scale = math.radians(1) if kind in ("revolute", "screw") else 1.0
    return scale * torch.tensor([0.0, *values], dtype=D)


def _case(
    seed: int, kind: str, *values: float, points: Tensor | None = None, distance: float = 0.3, **settings
) -> JointCase:
    """A joint of random direction at a distance from the part; values in degrees or radii, of states 1 and up."""
    case = random_case(seed, kind, 2, covariance=False)
    points = case.points if points is None else points
    across = normalize(torch.linalg.cross(case.axis, case.origin), dim=0)
    origin = points.mean(0) + distance * across
    return JointCase(kind, points, case.axis, origin, _values(kind, *values), **{"noise": 0.003, **settings})


def _flat(seed: int, thickness: tuple[float, float, float]) -> Tensor:
    """Points of a part that has no extent along some of x, y, z, about a random place, turned at random."""
    generator = torch.Generator().manual_seed(seed)
    x = (torch.rand(300, 3, generator=generator, dtype=D) - 0.5) * torch.tensor(thickness, dtype=D)
    R = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=D)).Q
    return x @ R.mT + 0.4 * torch.randn(3, generator=generator, dtype=D)


def _round(shape: str, hinge: str, *values: float) -> JointCase:
    """A disc, cylinder or sphere whose images do not tell its turn about z (the sphere's: about anything).

    It turns about its own axis, or about a line along x at its rim.
    """
    angle = torch.arange(300, dtype=D) * 2.4
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    up = torch.linspace(-1, 1, 300, dtype=D)[:, None]
    points = 0.2 * {"disc": ring, "cylinder": ring + 2 * up * Z, "sphere": (1 - up**2).sqrt() * ring + up * Z}[shape]
    axis, origin = (Z, torch.zeros(3, dtype=D)) if hinge == "own" else (X, torch.tensor([0, 0.3, 0], dtype=D))
    case = JointCase("revolute", points, axis, origin, _values("revolute", *values))
    spin = case.truth()[:, :3, 2]
    unseen = torch.eye(3, dtype=D).expand(len(spin), 3, 3) if shape == "sphere" else spin[:, :, None] * spin[:, None]
    case.covariance = torch.nn.functional.pad(math.pi**2 * unseen, (3, 0, 3, 0))
    return case


HARD_CASES = {
    "rotation of 0": lambda seed: _case(seed, "revolute", 0.0),
    "rotation of 1e-6 deg": lambda seed: _case(seed, "revolute", 1e-6),
    "rotation of 1e-6 deg, noise 1e-12": lambda seed: _case(seed, "revolute", 1e-6, noise=1e-12),
    "rotation of 179.9 deg": lambda seed: _case(seed, "revolute", 179.9),
    "rotation of 180 deg": lambda seed: _case(seed, "revolute", 180.0),
    "hinge at 20 radii, 5 deg": lambda seed: _case(seed, "revolute", 5.0, distance=20.0),
    "hinge at 20 radii, 5 states to 5 deg": lambda seed: _case(seed, "revolute", 2.0, -3.0, 5.0, -5.0, distance=20.0),
    "hinge at 100 radii, 0.1 deg": lambda seed: _case(seed, "revolute", 0.1, distance=100.0),
    "hinge at 100 radii, 5 states to 1 deg": lambda seed: _case(seed, "revolute", 0.2, 0.5, -0.5, 1.0, distance=100.0),
    "hinge at 100 radii, 5 states to 1 deg, noise 1e-5": lambda seed: _case(
        seed, "revolute", 0.2, 0.5, -0.5, 1.0, distance=100.0, noise=1e-5
    ),
    "slide of 1e-4": lambda seed: _case(seed, "prismatic", 1e-4),
    "slide of 1e-4, noise 1e-6": lambda seed: _case(seed, "prismatic", 1e-4, noise=1e-6),
    "no motion, 3 states": lambda seed: _case(seed, "revolute", 0.0, 0.0),
    "one Gaussian slides": lambda seed: _case(seed, "prismatic", 0.3, points=_flat(seed, (0, 0, 0))[:1]),
    "one Gaussian turns, 5 states": lambda seed: _case(
        seed, "revolute", 20.0, -30.0, 45.0, 60.0, points=_flat(seed, (0, 0, 0))[:1]
    ),
    "collinear turns": lambda seed: _case(seed, "revolute", 40.0, points=_flat(seed, (0.4, 0, 0))),
    "collinear turns, 5 states": lambda seed: _case(
        seed, "revolute", 20.0, -30.0, 45.0, 60.0, points=_flat(seed, (0.4, 0, 0))
    ),
    "coplanar turns": lambda seed: _case(seed, "revolute", 40.0, points=_flat(seed, (0.4, 0.3, 0))),
    "disc about its own axis": lambda seed: _round("disc", "own", 40.0),
    "disc about its rim": lambda seed: _round("disc", "rim", 40.0),
    "disc about its rim, 5 states": lambda seed: _round("disc", "rim", 20.0, -30.0, 45.0, 60.0),
    "cylinder about its own axis": lambda seed: _round("cylinder", "own", 40.0),
    "cylinder about its rim": lambda seed: _round("cylinder", "rim", 40.0),
    "cylinder about its rim, 5 states": lambda seed: _round("cylinder", "rim", 20.0, -30.0, 45.0, 60.0),
    "sphere beside the axis": lambda seed: _round("sphere", "rim", 40.0),
    "sphere beside the axis, 5 states": lambda seed: _round("sphere", "rim", 20.0, -30.0, 45.0, 60.0),
    "2 states": lambda seed: _case(seed, "revolute", 40.0),
    "3 states": lambda seed: _case(seed, "revolute", 20.0, 40.0),
    "10 states": lambda seed: _case(seed, "revolute", *range(5, 50, 5)),
}
"""Cases by name, of a seed."""


@dataclass
class TreeCase:
    """Parts of an object and their motions at the states."""

    points: dict[int, Tensor]
    motions: dict[int, Tensor]
    truth: KinematicTree
    noise: float
    """Error of the motions at the parts' surfaces, as a share of the object's radius."""

    @staticmethod
    def of(
        points: dict[int, Tensor],
        joints: list[tuple[int, int, str, Tensor, Tensor]],
        states: int,
        seed: int,
        noise: float = 0.001,
    ):
        """Joints are (parent, child, type, axis, origin); they move at random."""
        generator = torch.Generator().manual_seed(seed)
        travel = torch.tensor([0.2 if kind == "prismatic" else 0.7 for _, _, kind, _, _ in joints], dtype=D)
        share = torch.rand(states - 1, len(joints), 2, generator=generator, dtype=D)
        q = torch.nn.functional.pad(travel * (0.3 + 0.7 * share[..., 0]) * (share[..., 1] - 0.5).sign(), (0, 0, 1, 0))
        fits = [
            JointFit(kind, normalize(axis, dim=0), o, 0.0, q[:, k], 0.0)
            for k, (_, _, kind, axis, o) in enumerate(joints)
        ]
        truth = KinematicTree(
            sorted(points), 1, [TreeJoint(*joint[:2], fit) for joint, fit in zip(joints, fits, strict=True)]
        )
        motions, radius = {}, object_radius(points)
        for part, T in zip(truth.part_ids, forward_kinematics(truth, q).unbind(1), strict=True):
            x = points[part]
            about = from_rotation_translation(torch.eye(3, dtype=D), x.mean(0))
            C = surface_noise(x, noise, radius).expand(states, 6, 6)
            error = se3_exp(_draws(C, generator))
            motions[part] = T if part == 1 else torch.cat([T[:1], (T @ about @ error @ inverse(about))[1:]])
        return TreeCase(points, motions, truth, noise)

    def right_edges(self, tree: KinematicTree) -> int:
        return len({(j.parent, j.child) for j in tree.joints} & {(j.parent, j.child) for j in self.truth.joints})


def _bar(start: Tensor, end: Tensor, generator: torch.Generator, count: int = 400) -> Tensor:
    along = 1.1 * torch.rand(count, 1, generator=generator, dtype=D) - 0.05
    return start + along * (end - start) + 0.06 * (torch.rand(count, 3, generator=generator, dtype=D) - 0.5)


def parallel_chain(seed: int, states: int) -> TreeCase:
    """Four links in a row whose three hinges are parallel."""
    generator = torch.Generator().manual_seed(seed)
    points = {k + 1: _bar(0.4 * k * X, 0.4 * (k + 1) * X, generator) for k in range(4)}
    return TreeCase.of(points, [(k, k + 1, "revolute", Z, 0.4 * k * X) for k in (1, 2, 3)], states, seed)


def coincident_axes(seed: int, states: int) -> TreeCase:
    """A base and two arms, one on the other, that turn about one line."""
    generator = torch.Generator().manual_seed(seed)
    points = {k + 1: _bar(0.08 * k * Z, 0.08 * k * Z + 0.5 * X, generator) for k in range(3)}
    return TreeCase.of(points, [(k, k + 1, "revolute", Z, 0 * Z) for k in (1, 2)], states, seed)


def random_object(parts: int, states: int, seed: int = 0, noise: float = 0.001) -> TreeCase:
    """A branching chain of bars on hinges and slides of random directions."""
    generator = torch.Generator().manual_seed(seed)

    def direction() -> Tensor:
        return normalize(torch.randn(3, generator=generator, dtype=D), dim=0)

    ends = {1: 0.3 * direction()}
    points, joints = {1: _bar(0 * Z, ends[1], generator)}, []
    for part in range(2, parts + 1):
        parent = int(torch.randint(max(1, part - 3), part, (1,), generator=generator))
        start = ends[parent]
        # Of a few directions the one with the most room.
        others = torch.stack(list(ends.values()))
        tries = [start + 0.3 * direction() for _ in range(10)]
        ends[part] = max(tries, key=lambda end: float(torch.linalg.vector_norm(others - end, dim=-1).min()))
        points[part] = _bar(start, ends[part], generator)
        joints.append((parent, part, "prismatic" if part % 4 == 0 else "revolute", direction(), start))
    return TreeCase.of(points, joints, states, seed, noise)


TREE_CASES = {"parallel-axis chain of three": parallel_chain, "two coincident axes": coincident_axes}
