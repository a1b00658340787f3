import math

import numpy as np
import pytest
import torch
import trimesh

from splatart_ns.bundle import JOINT_DOFS, Bundle, Joint, Part
from splatart_ns.bundle.export import PartShape, describe, simulation, validation
from splatart_ns.splats import Splat

D = torch.float64
VALUES = {
    "fixed": [0.0, 0.0, 0.0],
    "revolute": [0.0, 1.2, 0.5],
    "prismatic": [0.0, -0.3, 0.1],
    "screw": [0.0, 2.0, 4.0],
    "cylindrical": [[0.0, 0.0], [0.2, 1.0], [-0.1, 0.4]],
    "spherical": [[0.0, 0, 0], [0.4, -0.2, 0.3], [-0.1, 0.5, 0.2]],
    "free": [[0.0] * 6, [0.3, 0.5, -0.1, 0.04, -0.2, 0.03], [0.0, -0.1, 0.2, 0.01, 0.03, -0.02]],
}


def link_centre(number: int) -> list[float]:
    """Boxes a little apart on a slanted line, so that no two touch and every joint has a lever."""
    return [0.7 * number, 0.2 * number, 0.1 * number]


def joint(name: str, kind: str, parent: str, child: str, number: int, **changes) -> Joint:
    """A joint with a slanted axis between the boxes `number` - 1 and `number`."""
    axis = torch.tensor([0.3, -0.5, 0.8], dtype=D)
    values = torch.tensor(VALUES[kind], dtype=D)
    fields = dict(
        name=name,
        type=kind,
        parent=parent,
        child=child,
        axis=axis / axis.norm(),
        origin=torch.tensor(link_centre(number), dtype=D) - torch.tensor([0.35, 0.1, 0.05], dtype=D),
        values=values,
        limits=(float(values.min()), float(values.max())) if JOINT_DOFS[kind] <= 1 else None,
        pitch=0.03 if kind == "screw" else 0.0,
    )
    return Joint(**fields | changes)


def part_splat(number: int) -> Splat:
    g = torch.Generator().manual_seed(number)
    return Splat(
        means=torch.tensor(link_centre(number)) + 0.1 * torch.randn(6, 3, generator=g),
        quats=torch.randn(6, 4, generator=g),
        log_scales=torch.full((6, 3), math.log(0.05)),
        opacity_logits=torch.full((6,), 4.0),
        sh=torch.randn(6, 1, 3, generator=g),
    )


def make_bundle(names: list[str], joints: list[Joint], **changes) -> Bundle:
    eye = torch.eye(4, dtype=D).expand(3, 4, 4).clone()
    covariance = torch.full((3, 6, 6), math.nan, dtype=D)
    parts = [Part(i + 1, name, part_splat(i), eye, covariance) for i, name in enumerate(names)]
    return Bundle(parts, joints, names[0], ["a", "b", "c"], **{"length_unit": "metre"} | changes)


def chain(kinds: list[str], **changes) -> Bundle:
    """Boxes p0, p1, ... one after the other, joined by joints j1, j2, ... of the given types."""
    names = [f"p{i}" for i in range(len(kinds) + 1)]
    joints = [joint(f"j{i + 1}", kind, names[i], names[i + 1], i + 1) for i, kind in enumerate(kinds)]
    return make_bundle(names, joints, **changes)


def box_shapes(bundle: Bundle, size: float = 0.3) -> dict[str, PartShape]:
    shapes = {}
    for i, part in enumerate(bundle.parts):
        box = trimesh.creation.box([size, 0.8 * size, 0.6 * size])
        box.apply_translation(link_centre(i))
        box.visual.vertex_colors = np.tile(np.array([200, 20 * i, 40, 255], np.uint8), (8, 1))
        shapes[part.name] = PartShape(box, (box,))
    return shapes


@pytest.fixture(autouse=True)
def short_checks(monkeypatch):
    """Twenty configurations show what a hundred do, and three seconds what ten do."""
    monkeypatch.setattr(validation, "CONFIGURATIONS", 20)
    monkeypatch.setattr(simulation, "SECONDS", 3.0)


@pytest.fixture
def objects():
    """Makers of bundles, and of their robots with boxes for meshes."""

    class Objects:
        make_bundle, chain, joint, shapes = map(staticmethod, (make_bundle, chain, joint, box_shapes))

        @staticmethod
        def robot(bundle: Bundle, **changes):
            return describe(bundle, box_shapes(bundle), "thing", **changes)

    return Objects
