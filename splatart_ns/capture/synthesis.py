"""A capture with ground truth, rendered from a URDF."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import trimesh

from splatart_ns.capture.capture import Camera
from splatart_ns.capture.images import depth_unit, write_depth, write_png
from splatart_ns.capture.joint_draws import draw_configurations
from splatart_ns.capture.ray_caster import RayCaster
from splatart_ns.capture.robot import Robot, read_urdf
from splatart_ns.capture.scene import Scene, camera_poses, ground_truth, part_surfaces
from splatart_ns.capture.surface import Surface
from splatart_ns.capture.synthesis_options import MOST_PIXELS, SynthesisOptions
from splatart_ns.errors import InputError
from splatart_ns.files import new_folder

POINTS_PER_PART = 10_000


def synthesize(urdf: Path, output_dir: Path, options: SynthesisOptions | None = None) -> Path:
    """Render a capture of a robot, with labels and ground truth.

    Every joint that can move does, between the states. The novel configuration in `eval/novel_00` lies half way
    between the first two states. The world is the frame of the URDF's root link, z up.

    Args:
        urdf: the robot's description.
        output_dir: a folder that does not exist yet, or is empty.
        options: the default ones if None.

    Returns:
        `output_dir`.

    Raises:
        InputError: a URDF or mesh that cannot be read, options that make no sense, an output folder in use.
    """
    options = options or SynthesisOptions()
    output_dir = Path(output_dir)
    _check(options)
    robot = read_urdf(Path(urdf))
    frozen = _frozen(robot, options)
    surfaces = part_surfaces(robot, frozen)
    scene = Scene.of(robot, frozen, surfaces, _configurations(robot, frozen, surfaces, options))
    with new_folder(output_dir) as folder:
        for k, values in enumerate(scene.configurations):
            _write_state(folder / f"state_{k:02d}", scene, values, options, options.train_views, k)
        if options.test_views > 0:
            _write_state(folder / "eval" / "novel_00", scene, scene.novel, options, 0, len(scene.configurations))
        _write_points(folder / "ground_truth_points", scene, options.seed)
        truth = ground_truth(scene, options.fov_degrees, options.resolution, options.length_unit, POINTS_PER_PART)
        if options.test_views == 0:
            truth["novel"] = []
        text = json.dumps(truth, indent=1)
        (folder / "ground_truth.json").write_text(text + "\n", encoding="utf-8")
    return output_dir


def _check(options: SynthesisOptions) -> None:
    def refuse(name: str, rule: str) -> None:
        raise InputError(f"The option {name.replace('_', '-')} is {getattr(options, name)!r}; give {rule}.")

    ranges = {"states": (2, 1000), "train_views": (1, 100_000), "test_views": (0, 100_000), "samples": (1, 64)}
    for name, (least, most) in (ranges | {"resolution": (8, MOST_PIXELS)}).items():
        if getattr(options, name) < least:
            refuse(name, f"{least} or more")
        if getattr(options, name) > most:
            refuse(name, f"{most} or less")
    if not 1.0 <= options.fov_degrees <= 120.0:
        refuse("fov_degrees", "1 to 120")
    if not 0.0 <= options.labelled_fraction <= 1.0:
        refuse("labelled_fraction", "0 to 1")
    if options.views not in ("sphere", "hemisphere"):
        refuse("views", "sphere or hemisphere")
    if not options.length_unit.strip():
        refuse("length_unit", "a name, as metre")
    if options.seed < 0:
        refuse("seed", "0 or more")
    if len(options.joint_values) == 1:
        refuse("joint_values", "the values of two states or more")
    if not 0.0 < np.linalg.norm(options.light.direction) < math.inf or not 0.0 <= options.light.ambient <= 1.0:
        refuse("light", "a direction that is not zero and an ambient share of 0 to 1")


def _assignments(text: str, robot: Robot) -> dict[str, float]:
    """{"a": 1.0, "b": 2.0} of "a=1,b=2"."""
    values = {}
    for item in filter(None, (x.strip() for x in text.split(","))):
        name, _, number = (x.strip() for x in item.partition("="))
        joint = robot.joint(name)
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"The joint value {item!r} is not of the form joint=number; write for example {name}=0.5.")
        if joint.mimic is not None:
            raise InputError(f"{robot.path}: joint {name!r} mimics {joint.mimic.joint!r}; give a value to that one.")
        if joint.limits is not None and not joint.limits[0] - 1e-9 <= value <= joint.limits[1] + 1e-9:
            low, high = joint.limits
            raise InputError(
                f"{robot.path}: joint {name!r} cannot be at {value:g}; its limits are {low:g} to {high:g}."
            )
        if name in values:
            raise InputError(f"The joint {name!r} has two values; leave out one of them.")
        values[name] = value
    return values


def _frozen(robot: Robot, options: SynthesisOptions) -> dict[str, float]:
    """Values of the joints held by the user, and of those that mimic them."""
    frozen: dict[str, float] = {}
    for text in options.freeze:
        frozen.update(_assignments(text, robot))
    values = robot.complete(frozen)
    followers = [j for j in robot.movable if j.mimic is not None]
    while new := {j.name: values[j.name] for j in followers if j.mimic.joint in frozen and j.name not in frozen}:
        frozen.update(new)
    return frozen


def _unfrozen(text: str, robot: Robot, frozen: Mapping[str, float]) -> dict[str, float]:
    """As `_assignments`, which must not contradict what is frozen."""
    values = _assignments(text, robot)
    for name in values.keys() & frozen.keys():
        if values[name] != frozen[name]:
            raise InputError(
                f"{robot.path}: joint {name!r} is frozen at {frozen[name]:g} and given the value {values[name]:g}; "
                "leave out one of them."
            )
    return values


def _configurations(
    robot: Robot, frozen: Mapping[str, float], surfaces: Mapping[str, Surface], options: SynthesisOptions
) -> list[dict[str, float]]:
    """The values of all movable joints, for each state."""
    if options.joint_values:
        return [robot.complete({**_unfrozen(text, robot, frozen), **frozen}) for text in options.joint_values]
    return draw_configurations(robot, frozen, surfaces, options.states, options.seed)


def _write_state(
    folder: Path, scene: Scene, values: Mapping[str, float], options: SynthesisOptions, train_views: int, index: int
) -> None:
    """Images, labels, silhouettes and transforms.json of one configuration."""
    size = options.resolution
    focal = 0.5 * size / math.tan(math.radians(0.5 * options.fov_degrees))
    camera = Camera(focal, focal, 0.5 * size, 0.5 * size, size, size)
    rng = np.random.default_rng([options.seed, 1, index])
    distance = scene.camera_distance(options.fov_degrees)
    poses = np.concatenate(
        [camera_poses(n, scene.centre, distance, options.views, rng) for n in (train_views, options.test_views)]
    )
    labelled = set(rng.permutation(train_views)[: round(options.labelled_fraction * train_views)].tolist())
    unit = depth_unit(distance + scene.radius)
    for name in ("images", "semantics", "masks", *["depth"] * options.depth):
        (folder / name).mkdir(parents=True)

    caster, frames = RayCaster(scene.placed(values)), []
    for i, T in enumerate(poses):
        seen = caster.render(camera, T, options.light, options.samples)
        name = f"{i:04d}.png"
        frame = {"file_path": f"images/{name}"}
        write_png(folder / "images" / name, cv2.cvtColor(seen.rgba, cv2.COLOR_RGBA2BGRA))
        if i in labelled or i >= train_views:
            write_png(folder / "semantics" / name, seen.part_ids)
            frame["semantics_path"] = f"semantics/{name}"
        write_png(folder / "masks" / name, seen.silhouette.astype(np.uint8) * 255)
        if options.depth:
            write_depth(folder / "depth" / name, seen.depth, unit)
            frame["depth_file_path"] = f"depth/{name}"
        frames.append({**frame, "transform_matrix": T.tolist(), "object_mask_path": f"masks/{name}"})

    train, test = [f["file_path"] for f in frames[:train_views]], [f["file_path"] for f in frames[train_views:]]
    transforms = {
        "camera_model": "OPENCV",
        "w": size,
        "h": size,
        "fl_x": focal,
        "fl_y": focal,
        "cx": 0.5 * size,
        "cy": 0.5 * size,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "length_unit": options.length_unit,
        **({"depth_unit_scale_factor": unit} if options.depth else {}),
        "semantic_classes": ["background", *scene.ids],
        "train_filenames": train,
        "val_filenames": test,
        "test_filenames": test,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(transforms, indent=1) + "\n", encoding="utf-8")


def _write_points(folder: Path, scene: Scene, seed: int) -> None:
    folder.mkdir()
    for i, surface in scene.placed(scene.configurations[0]).items():
        points = surface.sample(POINTS_PER_PART, np.random.default_rng([seed, 2, i]))
        trimesh.PointCloud(points.astype(np.float32)).export(folder / f"part_{i}.ply")
