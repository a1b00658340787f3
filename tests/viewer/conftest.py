"""A base with a lid that turns and a drawer that slides, each of one colour."""

import math

import pytest
import torch

from splatart_ns.bundle import Bundle, Joint, Part, joint_motion
from splatart_ns.splats import Splat

D = torch.float64
RED, GREEN, BLUE = torch.eye(3)


def box(centre, size, colour, n=300) -> Splat:
    g = torch.Generator().manual_seed(0)
    return Splat(
        means=torch.tensor(centre) + torch.tensor(size) * (torch.rand(n, 3, generator=g) - 0.5),
        quats=torch.randn(n, 4, generator=g),
        log_scales=torch.full((n, 3), math.log(0.08)),
        opacity_logits=torch.full((n,), 3.0),
        sh=((colour - 0.5) / 0.28209479177387814).expand(n, 1, 3).clone(),
    )


@pytest.fixture
def bundle() -> Bundle:
    lid = Joint(
        name="hinge",
        type="revolute",
        parent="base",
        child="lid",
        axis=torch.tensor([0.0, 1, 0], dtype=D),
        origin=torch.tensor([-0.5, 0, 0.6], dtype=D),
        values=torch.tensor([0.0, -math.pi / 2], dtype=D),
        limits=(-math.pi / 2, 0.0),
        covariance={"axis": (1e-4 * torch.eye(3)).tolist(), "origin": None},
    )
    drawer = Joint(
        name="runner",
        type="prismatic",
        parent="base",
        child="drawer",
        axis=torch.tensor([1.0, 0, 0], dtype=D),
        origin=torch.zeros(3, dtype=D),
        values=torch.tensor([0.0, 0.4], dtype=D),
        limits=(0.0, 0.4),
    )
    eye = torch.eye(4, dtype=D)
    covariance = torch.zeros(2, 6, 6, dtype=D)

    def part(number, name, splat, motion):
        return Part(number, name, splat, torch.stack([eye, motion]), covariance)

    return Bundle(
        parts=[
            part(1, "base", box([0.0, 0, 0], [1.0, 1, 1], RED), eye),
            part(2, "lid", box([0.0, 0, 0.7], [1.0, 1, 0.1], GREEN), joint_motion(lid, lid.values[1])),
            part(3, "drawer", box([0.6, 0, 0], [0.1, 0.6, 0.3], BLUE), joint_motion(drawer, drawer.values[1])),
        ],
        joints=[lid, drawer],
        root="base",
        states=["state_00", "state_01"],
        length_unit="metre",
        provenance={"version": "0.1.0", "seed": 0, "settings": {}},
    )
