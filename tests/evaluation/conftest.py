"""A cabinet of three parts, as ground truth, as a perfect estimate, and as a capture on disk."""

import copy
import functools
import json
import math

import cv2
import numpy as np
import pytest
import torch
import trimesh

from splatart_ns.bundle import (
    Bundle,
    Joint,
    Part,
    configured_motions,
    joint_motion,
    moved_splat,
    observed_motions,
    part_features,
)
from splatart_ns.bundle.articulated_splat import predicted_parts
from splatart_ns.bundle.surface import part_surface
from splatart_ns.evaluation import geometry
from splatart_ns.evaluation.ground_truth import GroundTruth, NovelState, TrueJoint
from splatart_ns.geometry.camera import viewmat_from_opengl
from splatart_ns.rasterize.render import render
from splatart_ns.splats import Splat

D = torch.float64
NAMES = {1: "body", 2: "door", 3: "latch"}
CENTRES = {1: [0.0, 0.0, 0.0], 2: [0.0, 0.8, 0.0], 3: [0.4, 1.0, 0.4]}
NOVEL = {"hinge": 0.2, "slide": 0.1}
ZERO = {"hinge": 0.3, "slide": -0.1}


def points_of(part: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(part)
    return torch.tensor(CENTRES[part]) + 0.5 * (torch.rand(60, 3, generator=g) - 0.5)


def make_joints() -> list[Joint]:
    hinge = Joint(
        name="hinge",
        type="revolute",
        parent="body",
        child="door",
        axis=torch.tensor([0.0, 0, 1], dtype=D),
        origin=torch.tensor([0.0, 0.4, 0], dtype=D),
        values=torch.tensor([0.0, 0.5], dtype=D),
        limits=(0.0, 0.5),
    )
    slide = Joint(
        name="slide",
        type="prismatic",
        parent="door",
        child="latch",
        axis=torch.tensor([0.6, 0.8, 0], dtype=D),
        origin=torch.tensor([0.4, 1.0, 0.4], dtype=D),
        values=torch.tensor([0.0, 0.3], dtype=D),
        limits=(0.0, 0.3),
    )
    return [hinge, slide]


def make_bundle() -> Bundle:
    joints = make_joints()
    door = joint_motion(joints[0], 0.5)
    motions = {1: torch.eye(4, dtype=D), 2: door, 3: door @ joint_motion(joints[1], 0.3)}
    parts = []
    for part, name in NAMES.items():
        means = points_of(part)
        n = len(means)
        splat = Splat(
            means=means,
            quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
            log_scales=torch.full((n, 3), math.log(0.06)),
            opacity_logits=torch.full((n,), 4.0),
            sh=torch.randn(n, 1, 3, generator=torch.Generator().manual_seed(part)),
        )
        motion = torch.stack([torch.eye(4, dtype=D), motions[part]])
        parts.append(Part(part, name, splat, motion, torch.full((2, 6, 6), math.nan, dtype=D)))
    return Bundle(parts, joints, "body", ["state_00", "state_01"], "metre")


def make_truth() -> GroundTruth:
    bundle = make_bundle()
    ids = {name: part for part, name in NAMES.items()}
    return GroundTruth(
        parts=NAMES,
        root=1,
        joints=[
            TrueJoint(
                *(j.name, j.type, ids[j.parent], ids[j.child], j.parent, j.child, j.axis, j.origin),
                values=j.values,
                absolute_zero=ZERO[j.name],
            )
            for j in bundle.joints
        ],
        motions={part.id: part.motion for part in bundle.parts},
        novel=[
            NovelState("eval/novel_00", NOVEL, {ids[n]: T for n, T in configured_motions(bundle, NOVEL).items()}),
        ],
        points={part: points_of(part).double() for part in NAMES},
        radius=1.5,
    )


def write_truth(folder) -> None:
    truth = make_truth()
    named = {"motion_from_state_0": None}
    states = [
        {**named, "index": s, "motion_from_state_0": {NAMES[p]: T[s].tolist() for p, T in truth.motions.items()}}
        for s in range(2)
    ]
    value = {
        "format": "articulated-ground-truth-1",
        "parts": [{"id": p, "name": n, "has_geometry": True, "root": p == 1} for p, n in NAMES.items()],
        "joints": [
            {
                "name": j.name,
                "type": j.type,
                "parent": j.parent_name,
                "child": j.child_name,
                "parent_id": j.parent,
                "child_id": j.child,
                "axis": j.axis.tolist(),
                "origin": j.origin.tolist(),
                "values": (j.values + ZERO[j.name]).tolist(),
            }
            for j in truth.joints
        ],
        "states": states,
        "novel": [
            {
                "folder": "eval/novel_00",
                "joint_values": {name: NOVEL[name] + ZERO[name] for name in NOVEL},
                "motion_from_state_0": {NAMES[p]: T.tolist() for p, T in truth.novel[0].motions.items()},
            }
        ],
        "cameras": {"object_bounding_radius": truth.radius},
    }
    (folder / "ground_truth.json").write_text(json.dumps(value))
    (folder / "ground_truth_points").mkdir()
    for part, points in truth.points.items():
        trimesh.PointCloud(points.numpy()).export(folder / "ground_truth_points" / f"part_{part}.ply")


def write_state(folder, bundle: Bundle, motions) -> None:
    """Four views of 40 x 32 pixels, three of them to train on, rendered from the estimate itself."""
    size, focal = (40, 32), 45.0
    K = torch.tensor([[focal, 0, 20], [0, focal, 16], [0, 0, 1]])
    ids = torch.tensor([part.id for part in bundle.parts])
    frames = []
    for kind in ("images", "semantics"):
        (folder / kind).mkdir(parents=True)
    for k in range(4):
        angle = 0.4 + k
        back = np.array([math.cos(angle), math.sin(angle), 0.5]) / math.hypot(1, 0.5)
        right = np.array([-math.sin(angle), math.cos(angle), 0.0])
        T = np.eye(4)
        T[:3] = np.stack([right, np.cross(back, right), back, 4 * back + [0.1, 0.5, 0.1]], axis=1)
        viewmat = viewmat_from_opengl(torch.from_numpy(T)).float()[None]
        rendering = render(moved_splat(bundle, motions), viewmat, K[None], *size, features=part_features(bundle))
        alpha = rendering.accumulation[0]
        rgb = (rendering.rgb[0] / alpha.clamp_min(1e-6)).clamp(0, 1)
        image = (255 * torch.cat([rgb.flip(-1), alpha], -1)).round().byte().numpy()
        cv2.imwrite(str(folder / "images" / f"{k}.png"), image)
        cv2.imwrite(
            str(folder / "semantics" / f"{k}.png"), predicted_parts(alpha, rendering.features[0], ids).byte().numpy()
        )
        paths = {"file_path": f"images/{k}.png", "semantics_path": f"semantics/{k}.png"}
        frames.append({**paths, "transform_matrix": T.tolist()})
    meta = {"fl_x": focal, "fl_y": focal, "cx": 20, "cy": 16, "w": size[0], "h": size[1], "frames": frames}
    meta |= {
        "semantic_classes": ["background", *NAMES.values()],
        "train_filenames": [f"images/{k}.png" for k in (0, 1, 2)],
    }
    meta |= {"test_filenames": ["images/3.png"]}
    (folder / "transforms.json").write_text(json.dumps(meta))


@pytest.fixture
def bundle() -> Bundle:
    """A perfect estimate."""
    return make_bundle()


@pytest.fixture
def truth() -> GroundTruth:
    return copy.deepcopy(make_truth())


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """A capture on disk whose images show the perfect estimate. Do not write into it."""
    folder, bundle = tmp_path_factory.mktemp("capture"), make_bundle()
    with torch.no_grad():
        for state, name in enumerate(bundle.states):
            write_state(folder / name, bundle, observed_motions(bundle, state))
        write_state(folder / "eval" / "novel_00", bundle, configured_motions(bundle, NOVEL))
    write_truth(folder)
    return folder


@pytest.fixture(autouse=True)
def coarse_surfaces(monkeypatch):
    """Meshes of large voxels, which take a fraction of a second."""
    monkeypatch.setattr(geometry, "part_surface", functools.partial(part_surface, voxels=10_000))
