"""A dataset on disk: a capture with ground truth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from splatart_ns.bundle.animation import is_called_as_a_file
from splatart_ns.bundle.bundle import Bundle, Joint
from splatart_ns.bundle.dataset import Dataset, Sample
from splatart_ns.bundle.posing import configured_motions
from splatart_ns.capture.images import depth_unit, write_depth, write_png
from splatart_ns.errors import InputError
from splatart_ns.files import replacing, write_json
from splatart_ns.records import read_record

SETTINGS = "dataset.json"
_FORMAT = "splatart-dataset-1"
_TRUTH = ("revolute", "prismatic", "fixed")
"""The joints that ground_truth.json can tell."""
_MOST, _POINTS = 10_000_000, 10_000
_MIN_OPACITY = 0.5


def write_dataset(
    dataset: Dataset, folder: Path, count: int, track: Callable[[Sequence[int]], Iterable[int]] = iter
) -> bool:
    """Write the first `count` samples as a capture that `splatart fit` reads, a folder for each state.

    Images that are there already are kept: a run that was ended goes on, and a greater `count` adds images. What is
    written of a bundle is its ground truth to a fit of the images; nothing is written where the bundle has joints that
    ground_truth.json cannot tell. `track` is given the numbers of the missing images and hands them on, to show how far
    it is.

    Returns:
        Whether there is a ground truth.

    Raises:
        InputError: a count below the number of states, a folder that holds more images, or something else, or that is
            called as a picture or film.
    """
    states = dataset.options.states
    if count > _MOST:
        raise InputError(f"--dataset is {count}; give at most {_MOST} images")
    if count < states:
        raise InputError(f"--dataset is {count}; give at least an image for each of the {states} --states")
    if is_called_as_a_file(folder):
        raise InputError(f"{folder}: is called as a picture or film, but a dataset is a folder; give another --output")
    _claim(dataset, folder)
    if (there := sum(1 for _ in folder.glob("state_*/images/[0-9]*.png"))) > count:
        raise InputError(f"{folder}: holds {there} images, more than --dataset {count}; give another --output")
    unit = _depth_unit(dataset)
    for index in track([i for i in range(count) if not _image(folder, i, states).exists()]):
        _write_sample(dataset[index], folder, states, unit)
    told = all(joint.type in _TRUTH for joint in dataset.splat.bundle.tree_joints)
    if told:
        _write_points(dataset, folder / "ground_truth_points")
        write_json(folder / "ground_truth.json", ground_truth(dataset))
    for state in range(states):
        transforms = _transforms(dataset, range(state, count, states), unit)
        write_json(folder / f"state_{state:02d}" / "transforms.json", transforms)
    return told


def _claim(dataset: Dataset, folder: Path) -> None:
    """Note what the folder holds, or check that it is the same."""
    settings = {"format": _FORMAT, "bundle": _fingerprint(dataset.splat.bundle), **asdict(dataset.options)}
    path = folder / SETTINGS
    if path.exists():
        if read_record(path, "give another --output").fields != settings:
            raise InputError(f"{folder}: holds images of another bundle or other options; give another --output")
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is there already and no dataset of ours; give another --output")
    else:
        write_json(path, settings)


def _fingerprint(bundle: Bundle) -> str:
    digest = hashlib.sha256()
    for part in bundle.parts:
        digest.update(f"{part.id} {part.name}".encode())
        part.splat.map(lambda tensor: digest.update(tensor.cpu().numpy().tobytes()))
    for joint in bundle.tree_joints:
        told = [joint.name, joint.type, joint.parent, joint.child, joint.pitch, joint.limits]
        digest.update(json.dumps(told).encode())
        for tensor in (joint.axis, joint.origin, joint.values):
            digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def _depth_unit(dataset: Dataset) -> float:
    camera = dataset.camera(0)
    distance = float(np.linalg.norm(camera.T_world_camera[:3, 3].numpy() - dataset.centre))
    return depth_unit(distance + dataset.radius)


def _name(index: int, states: int) -> str:
    return f"{index // states:05d}.png"


def _image(folder: Path, index: int, states: int) -> Path:
    return folder / f"state_{index % states:02d}" / "images" / _name(index, states)


def _write_sample(sample: Sample, folder: Path, states: int, unit: float) -> None:
    """The image comes last: where it is, all is."""
    image = _image(folder, sample.index, states)
    state = image.parents[1]
    write_depth(state / "depth" / image.name, sample.depth, unit)
    write_png(state / "semantics" / image.name, sample.labels)
    write_png(image, cv2.cvtColor(sample.rgba, cv2.COLOR_RGBA2BGRA))


def _transforms(dataset: Dataset, indices: Iterable[int], unit: float) -> dict[str, Any]:
    bundle, states = dataset.splat.bundle, dataset.options.states
    frames, camera = [], None
    for index in indices:
        camera, name = dataset.camera(index), _name(index, states)
        frames.append(
            {
                "file_path": f"images/{name}",
                "semantics_path": f"semantics/{name}",
                "depth_file_path": f"depth/{name}",
                "transform_matrix": camera.T_world_camera.tolist(),
            }
        )
    names = {part.id: part.name for part in bundle.parts}
    fx, fy, cx, cy = (float(camera.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return {
        "camera_model": "OPENCV",
        **{"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy},
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "length_unit": bundle.length_unit,
        "depth_unit_scale_factor": unit,
        "semantic_classes": ["background", *(names.get(i, f"part_{i}") for i in range(1, max(names) + 1))],
        "frames": frames,
    }


def ground_truth(dataset: Dataset) -> dict[str, Any]:
    """The content of ground_truth.json, as `splatart synth` writes it. The bundle's root stays where it is."""
    bundle, options = dataset.splat.bundle, dataset.options
    configurations = [dataset.configuration(state) for state in range(options.states)]
    poses = [configured_motions(bundle, q) for q in configurations]
    ids = {part.name: part.id for part in bundle.parts}
    index = {name: i for i, name in enumerate(ids)}
    shaped = {part.name for part in bundle.parts if len(part.splat)}

    def joint_record(joint: Joint) -> dict[str, Any]:
        T = poses[0][joint.parent]
        return {
            "name": joint.name,
            "type": joint.type,
            "parent": joint.parent,
            "child": joint.child,
            "parent_id": ids[joint.parent] if joint.parent in shaped else None,
            "child_id": ids[joint.child] if joint.child in shaped else None,
            "parent_index": index[joint.parent],
            "child_index": index[joint.child],
            "axis": (T[:3, :3] @ joint.axis).tolist(),
            "origin": (T[:3, :3] @ joint.origin + T[:3, 3]).tolist(),
            "limits": list(joint.limits),
            "mimic": None,
            "values": [q.get(joint.name, 0.0) for q in configurations],
        }

    return {
        "format": "articulated-ground-truth-1",
        "source": {"bundle": _fingerprint(bundle), "options": asdict(options)},
        "units": {
            "length": bundle.length_unit,
            "angle": "radian",
            "poses": "4x4, the bundle's canonical frame to world frame",
            "joint_axis_and_origin": "world frame, at state 0",
        },
        "world_frame": "canonical frame of the bundle",
        "segmentation": {"background": 0, "part_ids": {str(i): name for name, i in ids.items()}},
        "parts": [
            {
                "index": index[part.name],
                "id": part.id,
                "name": part.name,
                "has_geometry": part.name in shaped,
                "root": part.name == bundle.root,
            }
            for part in bundle.parts
        ],
        "joints": [joint_record(joint) for joint in bundle.tree_joints],
        "states": [
            {
                "index": k,
                "folder": f"state_{k:02d}",
                "joint_values": q,
                "part_poses": {name: T.tolist() for name, T in poses[k].items()},
                "motion_from_state_0": {name: (T @ poses[0][name].inverse()).tolist() for name, T in poses[k].items()},
            }
            for k, q in enumerate(configurations)
        ],
        "cameras": {
            "model": "pinhole",
            "convention": "OpenGL camera-to-world (x right, y up, looks along -z); pixel centres at +0.5",
            "look_at": dataset.centre.tolist(),
            "resolution": options.resolution,
            "object_bounding_radius": dataset.radius,
        },
        "novel": [],
        "points": f"ground_truth_points/part_<id>.ply: centres of visible Gaussians, at most {_POINTS}, at state 0",
    }


def _write_points(dataset: Dataset, folder: Path) -> None:
    poses = dataset.splat.link_poses(dataset.configuration(0))
    for part in dataset.splat.bundle.parts:
        if len(part.splat) == 0:
            continue
        opacities = part.splat.opacities
        centres = part.splat.means[opacities >= min(_MIN_OPACITY, float(opacities.max()))].double()
        chosen = np.random.default_rng([dataset.options.seed, 2, part.id]).permutation(len(centres))[:_POINTS]
        T = poses[part.name].numpy()
        points = centres.numpy()[chosen] @ T[:3, :3].T + T[:3, 3]
        with replacing(folder / f"part_{part.id}.ply") as temporary:
            trimesh.PointCloud(points.astype(np.float32)).export(temporary)
