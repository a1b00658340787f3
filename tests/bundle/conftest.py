import math

import pytest
import torch

from splatart_ns.bundle import Bundle, Joint, Part, joint_motion
from splatart_ns.splats import Splat

D = torch.float64


def part_splat(n: int, centre: list[float], seed: int, degree: int = 0) -> Splat:
    g = torch.Generator().manual_seed(seed)
    return Splat(
        means=torch.tensor(centre) + 0.1 * torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        log_scales=torch.full((n, 3), math.log(0.03)),
        opacity_logits=torch.full((n,), 3.0),
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=g),
    )


def make_bundle() -> Bundle:
    """base -> door (revolute about z through (1, 0, 0)) -> latch (prismatic along x), and a loop latch - base."""
    hinge = Joint(
        name="hinge",
        type="revolute",
        parent="base",
        child="door",
        axis=torch.tensor([0.0, 0, 1], dtype=D),
        origin=torch.tensor([1.0, 0, 0], dtype=D),
        values=torch.tensor([0.0, math.pi / 2], dtype=D),
        limits=(0.0, math.pi / 2),
        residual=1e-3,
        covariance={"values": [[0.1, 0.0], [0.0, 0.1]], "origin": None},
        alternatives=[
            {"type": "screw", "residual": 9e-4, "score": 1.5},
            {"type": "revolute", "residual": 2e-3, "score": 9.0, "parent": "latch"},
        ],
    )
    slide = Joint(
        name="slide",
        type="prismatic",
        parent="door",
        child="latch",
        axis=torch.tensor([1.0, 0, 0], dtype=D),
        origin=torch.tensor([2.0, 0, 0], dtype=D),
        values=torch.tensor([0.0, -0.25], dtype=D),
        limits=(-0.25, 0.0),
    )
    loop = Joint(
        name="closure",
        type="spherical",
        parent="latch",
        child="base",
        axis=torch.tensor([0.0, 1, 0], dtype=D),
        origin=torch.zeros(3, dtype=D),
        values=torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0.3]], dtype=D),
        limits=None,
        in_tree=False,
        ambiguous=True,
    )
    eye = torch.eye(4, dtype=D)
    door = joint_motion(hinge, hinge.values[1])
    latch = door @ joint_motion(slide, slide.values[1])
    undetermined = torch.full((6, 6), math.nan, dtype=D)
    covariance = torch.stack([torch.zeros(6, 6, dtype=D), undetermined])
    return Bundle(
        parts=[
            Part(1, "base", part_splat(5, [0.0, 0, 0], 1), torch.stack([eye, eye]), covariance),
            Part(2, "door", part_splat(6, [1.5, 0, 0], 2, degree=1), torch.stack([eye, door]), covariance),
            Part(7, "latch", part_splat(7, [2.0, 0, 0], 3), torch.stack([eye, latch]), covariance),
        ],
        joints=[slide, hinge, loop],
        root="base",
        states=["state_00", "state_01"],
        length_unit="metre",
        loops=[{"joint": "closure", "parts": ["base", "door", "latch"]}],
        provenance={"version": "0.1.0", "seed": 3, "settings": {"quality": "draft"}},
    )


@pytest.fixture
def bundle() -> Bundle:
    return make_bundle()
