"""Parts made of random points, their joints, and how they move: what tests of trees share."""

import math

import torch

from splatart_ns.geometry.se3 import from_rotation_translation, inverse, se3_exp
from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics
from splatart_ns.stages.joint_fit import JointFit

Z, X, Y = (torch.tensor(v, dtype=torch.float64) for v in ((0, 0, 1.0), (1.0, 0, 0), (0, 1.0, 0)))


def box(centre, size, seed, count=400):
    x = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.tensor(centre).double() + (x - 0.5) * torch.tensor(size).double()


def rod(start, end, width, seed, count=400):
    """Points in a cylinder-like bar between two places, reaching a little beyond both."""
    start, end = torch.as_tensor(start).double(), torch.as_tensor(end).double()
    generator = torch.Generator().manual_seed(seed)
    along = torch.rand(count, 1, generator=generator, dtype=torch.float64) * 1.1 - 0.05
    return (
        start + along * (end - start) + width * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5)
    )


def motions_of(tree: KinematicTree, q: torch.Tensor, points: dict | None = None, seed=0, rotation=0.0, translation=0.0):
    """Motions by part at configurations [S, J], with errors about the centroids if asked: radians and length."""
    generator = torch.Generator().manual_seed(seed)
    motions = {}
    for k, part in enumerate(tree.part_ids):
        T = forward_kinematics(tree, q)[:, k]
        if rotation > 0 and part != tree.root:
            about = from_rotation_translation(torch.eye(3, dtype=torch.float64), points[part].mean(0))
            way = torch.nn.functional.normalize(torch.randn(len(q), 2, 3, generator=generator).double(), dim=-1)
            error = about @ se3_exp(torch.cat([translation * way[:, 0], rotation * way[:, 1]], -1)) @ inverse(about)
            T = torch.cat([T[:1], (T @ error)[1:]])
        motions[part] = T
    return motions


def true_joint(parent, child, kind, axis, origin):
    axis, origin = torch.as_tensor(axis).double(), torch.as_tensor(origin).double()
    return Joint(parent, child, JointFit(kind, axis / torch.linalg.vector_norm(axis), origin, 0.0, torch.zeros(2), 0.0))


def edges(tree: KinematicTree) -> set[tuple[int, int]]:
    return {(j.parent, j.child) for j in tree.joints}


def four_bar(angles):
    """A linkage of ground 1, crank 2, coupler 3, rocker 4: joints in A (1-2), B (2-3), C (3-4), D (4-1)."""
    a, b, c, d = 1.0, 2.5, 2.0, 3.0
    placed = []
    for angle in angles:
        A, D = torch.tensor([0.0, 0, 0]).double(), torch.tensor([d, 0, 0]).double()
        B = A + a * torch.tensor([math.cos(angle), math.sin(angle), 0]).double()
        reach = D - B
        length = float(torch.linalg.vector_norm(reach))
        along = (b**2 - c**2 + length**2) / (2 * length)
        across = torch.linalg.cross(Z, reach / length)
        placed.append((A, B, B + along * reach / length + math.sqrt(b**2 - along**2) * across, D))

    def pose(p, q):
        x = (q - p) / torch.linalg.vector_norm(q - p)
        return from_rotation_translation(torch.stack([x, torch.linalg.cross(Z, x), Z], -1), p)

    poses = [torch.stack([pose(s[i], s[j]) for s in placed]) for i, j in ((0, 3), (0, 1), (1, 2), (3, 2))]
    motions = {k + 1: T @ inverse(T[0]) for k, T in enumerate(poses)}
    A, B, C, D = placed[0]
    points = {k: rod(*ends, 0.2, k) for k, ends in {1: (A, D), 2: (A, B), 3: (B, C), 4: (D, C)}.items()}
    return points, motions
