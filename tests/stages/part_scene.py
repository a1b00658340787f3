"""A small two-part object, its splats at two states, and what cameras see of it."""

import math

import torch

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import from_rotation_translation, inverse, se3_exp, so3_exp
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat

NUM_PARTS = 2


def motion(rotation, translation) -> torch.Tensor:
    """[4, 4] float64 of a rotation vector in degrees and a translation."""
    R = so3_exp(torch.tensor(rotation, dtype=torch.float64).deg2rad())
    return from_rotation_translation(R, torch.tensor(translation, dtype=torch.float64))


def angle_deg(A: torch.Tensor, B: torch.Tensor) -> float:
    cosine = ((A[:3, :3].T.double() @ B[:3, :3].double()).trace() - 1) / 2
    return math.degrees(math.acos(float(cosine.clamp(-1, 1))))


def box(part: int, size, centre, spacing: float = 0.06, num_parts: int = NUM_PARTS) -> Splat:
    """Gaussians on the faces of a box; the colour says the face and where on it."""
    size, centre = torch.tensor(size), torch.tensor(centre)
    points, colours = [], []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        u, v = (torch.arange(-float(size[a]) / 2, float(size[a]) / 2 + 1e-6, spacing) for a in others)
        for sign in (-1, 1):
            xyz = torch.zeros(len(u), len(v), 3)
            xyz[..., others[0]], xyz[..., others[1]] = u[:, None], v[None]
            xyz[..., axis] = sign * size[axis] / 2
            rgb = torch.full_like(xyz, 0.3)
            rgb[..., axis] = 0.55 + 0.3 * sign
            rgb[..., others[0]] += 0.3 * (u[:, None] > 0)
            points.append(xyz.reshape(-1, 3))
            colours.append(rgb.reshape(-1, 3))
    xyz, rgb = torch.cat(points) + centre, torch.cat(colours)
    n = len(xyz)
    return Splat(
        means=xyz,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(spacing * 0.6)),
        opacity_logits=torch.full((n,), 3.0),
        sh=((rgb - 0.5) / 0.28209479)[:, None],
        part_logits=torch.full((n, num_parts + 1), -8.0).index_fill(1, torch.tensor([part]), 0.0),
    )


def disc(part: int, T: torch.Tensor, size=(0.5, 0.08), mark: bool = False, spacing: float = 0.06) -> Splat:
    """Grey Gaussians on a disc about z, `size` its radius and half height, moved by T; its light stays in the world.

    A mark is a dark spot near the rim.
    """
    radius, half = size
    angle = torch.arange(0, 2 * math.pi, spacing / radius)
    up = torch.linspace(-half, half, max(2, round(2 * half / spacing) + 1))
    side = torch.cartesian_prod(angle, up)
    normals = torch.stack([side[:, 0].cos(), side[:, 0].sin(), torch.zeros(len(side))], -1)
    xyz = [torch.cat([radius * normals[:, :2], side[:, 1:]], -1)]
    normals = [normals]
    u = torch.arange(-radius, radius + 1e-6, spacing)
    flat = torch.cartesian_prod(u, u)
    flat = flat[flat.norm(dim=1) < radius]
    for z in (-half, half):
        xyz.append(torch.cat([flat, torch.full((len(flat), 1), z)], -1))
        normals.append(torch.tensor([0.0, 0.0, math.copysign(1, z)]).expand(len(flat), 3))
    xyz, normals = torch.cat(xyz), torch.cat(normals)
    light = (normals @ T[:3, :3].float().mT) @ torch.tensor([0.64, 0.48, 0.6])
    rgb = (0.5 + 0.15 * light)[:, None].repeat(1, 3)
    if mark:
        rgb[(xyz - torch.tensor([0.7 * radius, 0, half])).norm(dim=1) < 0.3 * radius] *= 0.4
    n = len(xyz)
    return Splat(
        means=xyz,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(spacing * 0.6)),
        opacity_logits=torch.full((n,), 3.0),
        sh=((rgb - 0.5) / 0.28209479)[:, None],
        part_logits=torch.full((n, NUM_PARTS + 1), -8.0).index_fill(1, torch.tensor([part]), 0.0),
    ).transformed(T)


def cameras(count: int, distance: float = 4.0) -> torch.Tensor:
    """World-to-camera transforms [count, 4, 4] from all around, looking at the origin."""
    mats = []
    for k in range(count):
        z = 1 - 2 * (k + 0.5) / count
        turn = k * math.pi * (3 - math.sqrt(5))
        forward = -torch.tensor([math.sqrt(1 - z * z) * math.cos(turn), math.sqrt(1 - z * z) * math.sin(turn), z])
        right = torch.linalg.cross(forward, torch.tensor([0.1, 0.2, 1.0]))
        right = right / right.norm()
        R = torch.stack([right, torch.linalg.cross(forward, right), forward])
        mats.append(from_rotation_translation(R, torch.tensor([0.0, 0.0, distance])))
    return torch.stack(mats)


def photograph(splat: Splat, count: int = 10, pixels: int = 64) -> list[View]:
    """What `count` cameras see, with alpha and labels."""
    K = torch.tensor([[1.4 * pixels, 0, pixels / 2], [0, 1.4 * pixels, pixels / 2], [0, 0, 1]])
    views = []
    for k, viewmat in enumerate(cameras(count)):
        r = render(splat, viewmat[None], K[None], pixels, pixels, features=splat.part_probabilities, with_depth=False)
        alpha = r.accumulation[0]
        labels = torch.where(alpha[..., 0] > 0.5, r.features[0].argmax(-1), 0)
        views.append(
            View(
                name=f"{k:04d}",
                viewmat=viewmat,
                K=K,
                width=pixels,
                height=pixels,
                rgb=(r.rgb[0] / alpha.clamp_min(1e-6) * 255).round().clamp(0, 255).to(torch.uint8),
                alpha=(alpha[..., 0] * 255).round().to(torch.uint8),
                labels=labels.to(torch.uint8),
            )
        )
    return views


def two_states(T: torch.Tensor, spacing: float = 0.06):
    """A still base (part 1) and a plate on it (part 2) that moves by T: splats and views of both states."""
    base = box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3), spacing)
    plate = box(2, (0.7, 0.4, 0.12), (0.1, 0.0, 0.2), spacing)
    splats = (Splat.cat([base, plate]), Splat.cat([base, plate.transformed(T)]))
    return splats, tuple(photograph(s) for s in splats)


def nearby(T: torch.Tensor, size: float, seed: int = 0) -> torch.Tensor:
    """T after a random motion of about `size` radians and lengths."""
    g = torch.Generator().manual_seed(seed)
    return se3_exp(size * torch.randn(6, generator=g, dtype=torch.float64)) @ T


OPENED = motion((60, 0, 0), (0.0, 0.1, 0.3))


def lit_lid(colour):
    """Opened it is lit from below, so that it fits better turned over, though its sides differ by twice a colour."""
    lid = box(1, (0.6, 0.4, 0.06), (0.0, 0.0, 0.0), spacing=0.04)
    above, front = lid.means[:, 2, None, None] > 0, lid.means[:, 1, None, None] > 0.1
    colours = torch.where(above, colour, -colour) * torch.tensor([1.0, -0.5, -0.5])
    colours = colours + torch.where(front, 0.4, 0.0) * torch.tensor([-0.5, 1.0, -0.5])
    opened = lid.transformed(OPENED)
    lid.sh, opened.sh = (torch.where(lit, 0.5, -0.1) + colours for lit in (above, ~above))
    splats = lid, opened
    return splats, tuple(photograph(s, count=20) for s in splats)


__all__ = [
    "NUM_PARTS",
    "OPENED",
    "angle_deg",
    "box",
    "disc",
    "inverse",
    "lit_lid",
    "motion",
    "nearby",
    "photograph",
    "two_states",
]
