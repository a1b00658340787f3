"""Copies of a capture with cameras, worlds or exposures as a phone leaves them, to fit and compare.

Usage:
    python benchmarks/spoil.py CAPTURE OUTPUT [--worlds] [--jitter 0.5] [--exposure 0.3]

The ground truth stays that of the world of the first state, and so do held-out configurations.
"""

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
from scipy.spatial.transform import Rotation


@dataclass
class Options:
    """What to do to which capture of state folders."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    output_dir: Annotated[Path, tyro.conf.Positional]
    """Folder of the copy; it does not exist yet."""
    worlds: bool = False
    """Give each state but the first another world: any rotation, a scale of 0.5 to 2."""
    jitter: float = 0.0
    """Turn every training camera by a normal number of degrees of this standard deviation about each axis, and move it
    by as many percent of its distance from the cameras' focus."""
    exposure: float = 0.0
    """Multiply each training image by 1 - exposure to 1 + exposure."""
    seed: int = 0
    """Of all of this."""


def main(options: Options) -> None:
    shutil.copytree(options.capture, options.output_dir, copy_function=shutil.copyfile)
    for k, file in enumerate(sorted(options.output_dir.glob("state_*/transforms.json"))):
        rng = np.random.default_rng([options.seed, k])
        meta = json.loads(file.read_text())
        poses = np.array([frame["transform_matrix"] for frame in meta["frames"]])
        train = np.array([frame["file_path"] in meta["train_filenames"] for frame in meta["frames"]])
        jittered(poses, train, math.radians(options.jitter), rng)
        if options.worlds and k > 0:
            world = another_world(rng)
            poses = [placed_in(world, pose) for pose in poses]
            meta["depth_unit_scale_factor"] = world[0] * meta.get("depth_unit_scale_factor", 1e-3)
            print(f"{file.parent.name}: scale {world[0]:.6f}")
        for frame, pose in zip(meta["frames"], poses, strict=True):
            frame["transform_matrix"] = pose.tolist()
        file.write_text(json.dumps(meta, indent=1))
        if options.exposure > 0:
            for name in meta["train_filenames"]:
                expose(file.parent / name, 1 + options.exposure * rng.uniform(-1, 1))


World = tuple[float, np.ndarray, np.ndarray]
"""A similarity: scale, rotation [3, 3], shift [3]."""


def another_world(rng: np.random.Generator) -> World:
    """Any rotation, a scale of 0.5 to 2."""
    return 2.0 ** rng.uniform(-1, 1), Rotation.random(random_state=rng).as_matrix(), rng.uniform(-5, 5, 3)


def placed_in(world: World, pose: np.ndarray) -> np.ndarray:
    """A camera's pose [4, 4] in another world."""
    scale, R, shift = world
    pose = pose.copy()
    pose[:3, :3] = R @ pose[:3, :3]
    pose[:3, 3] = scale * R @ pose[:3, 3] + shift
    return pose


def jittered(poses: np.ndarray, chosen: np.ndarray, size: float, rng: np.random.Generator) -> None:
    """Turn the chosen poses [N, 4, 4] by `size` radians, and move them by `size` / 1 degree percent of their
    distance from where all look."""
    across = np.eye(3) - poses[:, :3, 2, None] * poses[:, None, :3, 2]
    focus = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, poses[:, :3, 3]))
    distance = np.linalg.norm(poses[:, :3, 3] - focus, axis=1)
    turns, moves = rng.normal(size=(2, len(poses), 3))
    # A random axis: the angle's standard deviation is `size`, not each component's.
    turns, moves = turns / math.sqrt(3), moves / math.sqrt(3)
    R = Rotation.from_rotvec(size * turns).as_matrix()
    poses[chosen, :3, :3] = (R @ poses[:, :3, :3])[chosen]
    poses[chosen, :3, 3] += (0.01 * math.degrees(size) * distance[:, None] * moves)[chosen]


def expose(path: Path, gain: float) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(float)
    image[..., :3] *= gain
    cv2.imwrite(str(path), np.rint(image.clip(0, 255)).astype(np.uint8))


if __name__ == "__main__":
    main(tyro.cli(Options))
