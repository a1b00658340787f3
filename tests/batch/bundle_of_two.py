"""A small bundle: a lid that turns on a base."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from splatart_ns.bundle import Bundle, Joint, Part, save_bundle
from splatart_ns.splats import Splat

D = torch.float64


def save_box(folder: Path, seed: int) -> None:
    """Two blobs of opaque Gaussians, one on a hinge."""

    def blob(x: float, seed: int) -> Splat:
        g = torch.Generator().manual_seed(seed)
        return Splat(
            means=torch.tensor([x, 0.0, 0.0]) + 0.2 * torch.randn(150, 3, generator=g),
            quats=torch.randn(150, 4, generator=g),
            log_scales=torch.full((150, 3), math.log(0.08)),
            opacity_logits=torch.full((150,), 6.0),
            sh=torch.randn(150, 1, 3, generator=g),
        )

    turn = torch.eye(4, dtype=D)
    turn[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    hinge = Joint(
        name="hinge",
        type="revolute",
        parent="base",
        child="lid",
        axis=torch.tensor([0.0, 0, 1], dtype=D),
        origin=torch.zeros(3, dtype=D),
        values=torch.tensor([0.0, math.pi / 2], dtype=D),
        limits=(0.0, math.pi / 2),
    )
    nothing = torch.zeros(2, 6, 6, dtype=D)
    parts = [
        Part(1, "base", blob(0.0, seed), torch.eye(4, dtype=D).repeat(2, 1, 1), nothing),
        Part(2, "lid", blob(1.0, seed + 100), torch.stack([torch.eye(4, dtype=D), turn]), nothing),
    ]
    save_bundle(Bundle(parts, [hinge], "base", ["state_00", "state_01"], provenance={"version": "test"}), folder)
