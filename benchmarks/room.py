"""A person's path: a phone's distorted images of an object in a room, labels of a few frames from a polygon tool.

Usage:
    python benchmarks/room.py --output-dir /somewhere [--objects drawer hinge] [--labelled 10] [--quality draft]
    python benchmarks/room.py --output-dir /somewhere --objects A.urdf B.urdf --worlds --jitter 0.2 --exposure 0.1

Renders each object on the floor of a textured room, by cameras with radial and tangential distortion, as JPEGs without
alpha or masks, in the folders that `ns-process-data` leaves; outlines a few frames by hand-drawn polygons (within a
pixel) as COCO; then runs `splatart import`, `check`, `fit`, and `eval` against the truth, which lies apart. With
`--worlds` each state is in a world of its own, as COLMAP leaves states that were captured apart. Finished steps are not
repeated: remove what is to be made anew.
"""

import json
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
import tyro
from fit_table import COLUMNS, figures, splatart
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from skimage.measure import find_contours
from spoil import another_world, jittered, placed_in

from splatart_ns.capture.capture import Camera
from splatart_ns.capture.images import write_png
from splatart_ns.capture.joint_draws import draw_configurations
from splatart_ns.capture.light import Light
from splatart_ns.capture.procedural import build_object
from splatart_ns.capture.ray_caster import RayCaster
from splatart_ns.capture.robot import read_urdf
from splatart_ns.capture.scene import Scene, camera_poses, ground_truth, part_surfaces
from splatart_ns.capture.surface import Surface, join
from splatart_ns.capture.synthesis import POINTS_PER_PART
from splatart_ns.capture.textures import paint

OBJECTS: dict[str, tuple[dict[str, float], ...]] = {
    "hinge": ({"lid_joint": 0.5}, {"lid_joint": 1.7}),
    "drawer": ({"drawer_joint": 0.05}, {"drawer_joint": 0.2}),
    "arm": ({"yaw": -0.4, "shoulder": 0.1, "elbow": 1.5}, {"yaw": 0.5, "shoulder": 0.7, "elbow": 0.7}),
}
"""The states in which each is shown."""
CAMERA = Camera(310.0, 308.0, 163.0, 118.0, 320, 240, distortion=(-0.12, 0.04, 0.0, 0.0, 0.001, -0.0015))
LIGHT = Light(ambient=0.7)
_FIELD = 40.0
"""Degrees that the object's sphere, and as much about it, fills of an image."""
_PALETTES = (
    ((150, 112, 78), (176, 140, 104), (196, 168, 132), (96, 72, 52)),
    ((196, 200, 190), (214, 214, 204), (226, 224, 216), (120, 140, 120)),
    ((120, 140, 168), (146, 162, 184), (178, 188, 200), (232, 196, 120)),
)


@dataclass
class Options:
    """What to make and fit."""

    output_dir: Path
    """Folder for captures and bundles."""
    objects: tuple[str, ...] = ("drawer", "hinge")
    """Built-in objects, or URDF files, whose joint values are drawn as `splatart synth` does."""
    states: int = 2
    """How many states of a URDF file; built-in objects have two."""
    frames: int = 60
    """Frames of each state; every 8th is a test frame, as `splatart` chooses them."""
    labelled: int = 10
    """How many of them are labelled."""
    worlds: bool = False
    """Give each state but the first a world of its own: any rotation, a scale of 0.5 to 2."""
    jitter: float = 0.0
    """How many degrees, and percent of their distance, cameras are off (see spoil.py)."""
    exposure: float = 0.0
    """How much lighter or darker images are, at most: 0.1 is 0.9 to 1.1 times."""
    seed: int = 0
    """Of joint values, views, and all that is random."""
    quality: str = "standard"
    """Of `splatart fit`."""


def main(options: Options) -> None:
    table = Table("object", "labelled", "s", *COLUMNS, box=SIMPLE_HEAD, pad_edge=False)
    for name in options.objects:
        path = Path(name)
        folder = options.output_dir / f"{path.parent.name + '_' + path.stem if path.suffix else name}_{options.frames}"
        if not (folder / "truth/ground_truth.json").exists():
            write_room(name, folder, options)
        capture, bundle = (folder / f"{what}_{options.labelled}" for what in ("capture", "bundle"))
        bundle = bundle.with_name(f"{bundle.name}_{options.quality}")
        if not capture.exists():
            export = write_polygons(folder, options.labelled)
            states = sorted(folder.glob("phone_*"))
            splatart("import", *states, "--labels", export, "--output-dir", capture)
        splatart("check", capture)
        worlds = ("--worlds", "similar") if options.worlds else ()
        splatart("fit", capture, "--output-dir", bundle, "--quality", options.quality, *worlds)
        splatart("eval", bundle, "--data", folder / "truth")
        metrics, report = (json.loads((bundle / f"{file}.json").read_text()) for file in ("metrics", "report"))
        table.add_row(name, str(options.labelled), f"{report['seconds']:.0f}", *figures(metrics))
    Console().print(table)


def write_room(name: str, folder: Path, options: Options) -> None:
    """`phone_0`, `phone_1`, ...: what a phone and ns-process-data leave. `truth`: a capture with all labels,
    silhouettes and ground_truth.json."""
    with tempfile.TemporaryDirectory() as temporary:
        robot = read_urdf(build_object(name).write(Path(temporary)) if name in OBJECTS else Path(name))
        surfaces = part_surfaces(robot, {})
    if name in OBJECTS:
        configurations = [robot.complete(values) for values in OBJECTS[name]]
    else:
        configurations = draw_configurations(robot, {}, surfaces, options.states, options.seed)
    scene = Scene.of(robot, {}, surfaces, configurations)
    for k in range(len(configurations)):
        _write_state(folder, scene, k, options)
    (folder / "truth/ground_truth_points").mkdir()
    for i, surface in scene.placed(scene.configurations[0]).items():
        points = surface.sample(POINTS_PER_PART, np.random.default_rng(i)).astype(np.float32)
        trimesh.PointCloud(points).export(folder / f"truth/ground_truth_points/part_{i}.ply")
    truth = ground_truth(scene, _FIELD, CAMERA.width, "metre", POINTS_PER_PART) | {"novel": []}
    (folder / "truth/ground_truth.json").write_text(json.dumps(truth, indent=1))


def _write_state(folder: Path, scene: Scene, k: int, options: Options) -> None:
    rng, spoiling = (np.random.default_rng([stream, k + 1000 * options.seed]) for stream in (1, 2))
    parts, distance = scene.placed(scene.configurations[k]), scene.camera_distance(_FIELD)
    placed = [surface for values in scene.configurations for surface in scene.placed(values).values()]
    floor = min(surface.corners[..., 2].min() for surface in placed) - 1e-4
    caster = RayCaster({**parts, 0: _room(scene.centre, floor, 2.2 * distance)})
    phone, truth = folder / f"phone_{k}", folder / f"truth/state_{k:02d}"
    (phone / "images").mkdir(parents=True)
    true_poses = camera_poses(options.frames, scene.centre, distance, "hemisphere", rng)
    poses = true_poses.copy()
    jittered(poses, np.ones(len(poses), bool), math.radians(options.jitter), spoiling)
    world = another_world(spoiling) if options.worlds and k > 0 else (1.0, np.eye(3), np.zeros(3))
    entries: dict[Path, list[dict]] = {phone: [], truth: []}
    for i, (T, told) in enumerate(zip(true_poses, poses, strict=True)):
        seen = caster.render(CAMERA, T, LIGHT)
        file = f"images/frame_{i + 1:05d}"
        alpha = seen.rgba[..., 3:] / 255.0
        rgb = np.rint(seen.rgba[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
        write_png(truth / f"{file}.png", np.ascontiguousarray(rgb[..., ::-1]))
        write_png(truth / f"{file}_parts.png", seen.part_ids)
        write_png(truth / f"{file}_mask.png", seen.silhouette.astype(np.uint8) * 255)
        gain = 1 + options.exposure * spoiling.uniform(-1, 1)
        taken = np.rint(gain * rgb[..., ::-1]).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(phone / f"{file}.jpg"), taken, [cv2.IMWRITE_JPEG_QUALITY, 95])
        own = {"file_path": f"{file}.jpg", "colmap_im_id": i + 1}
        entries[phone].append({**own, "transform_matrix": placed_in(world, told).tolist()})
        own = {
            "file_path": f"{file}.png",
            "semantics_path": f"{file}_parts.png",
            "object_mask_path": f"{file}_mask.png",
        }
        entries[truth].append({**own, "transform_matrix": placed_in(world, T).tolist()})
    k1, k2, _, _, p1, p2 = CAMERA.distortion
    meta = {
        **{"w": CAMERA.width, "h": CAMERA.height, "fl_x": CAMERA.fx, "fl_y": CAMERA.fy, "cx": CAMERA.cx},
        **{"cy": CAMERA.cy, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "camera_model": "OPENCV"},
    }
    (phone / "transforms.json").write_text(json.dumps({**meta, "frames": entries[phone]}))
    meta["semantic_classes"] = ["background", *scene.ids]
    (truth / "transforms.json").write_text(json.dumps({**meta, "frames": entries[truth]}))


def _room(centre: np.ndarray, floor: float, half: float) -> Surface:
    """Floor and four walls about the object, painted."""
    low, high = floor - centre[2], 1.2 * half
    walls = []
    for i in range(5):
        turn = np.array([[1, 0], [0, 1]]) if i == 0 else _turned(i * math.pi / 2)
        if i == 0:
            corners = np.array([(-half, -half, low), (half, -half, low), (half, half, low), (-half, half, low)])
        else:
            corners = np.array([(-half, half, low), (half, half, low), (half, half, high), (-half, half, high)])
        corners[:, :2] = corners[:, :2] @ turn.T
        uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float)
        faces = np.array([(0, 1, 2), (0, 2, 3)])
        texture = paint(768, 768, _PALETTES[min(i, 1) + i % 2], 22.0, np.random.default_rng(i))
        walls.append(Surface.of(corners[faces] + centre, uv[faces], texture=texture))
    return join(walls)


def _turned(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def write_polygons(folder: Path, labelled: int) -> Path:
    """COCO polygons of frames spread over each state (test frames left out), a file for each state."""
    export = folder / f"annotations_{labelled}"
    for k, truth in enumerate(sorted((folder / "truth").glob("state_*"))):
        meta = json.loads((truth / "transforms.json").read_text())
        train = [e for i, e in enumerate(meta["frames"]) if i % 8 != 7]
        chosen = [train[i] for i in np.linspace(0, len(train) - 1, labelled).round().astype(int)]
        images, annotations = [], []
        for number, entry in enumerate(chosen):
            labels = cv2.imread(str(truth / entry["semantics_path"]), cv2.IMREAD_UNCHANGED)
            name = Path(entry["file_path"]).with_suffix(".jpg").name
            images.append({"id": number, "file_name": name, "width": meta["w"], "height": meta["h"]})
            for part in sorted(set(np.unique(labels).tolist()) - {0}):
                segmentation = _outlines(labels == part)
                if segmentation:
                    annotations.append({"image_id": number, "category_id": part, "segmentation": segmentation})
        categories = [{"id": i, "name": n} for i, n in enumerate(meta["semantic_classes"]) if i > 0]
        file = export / f"state_{k:02d}" / "_annotations.coco.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"images": images, "annotations": annotations, "categories": categories}))
    return export


def _outlines(mask: np.ndarray) -> list[list[float]]:
    """Polygons about a part's pieces as a person draws them: few corners, within a pixel, holes left out of sight."""
    # Along pixels' borders: contours through the centres of the outermost pixels would be half a pixel too small.
    around = np.pad(mask, 1).astype(float)
    contours = [c[:-1, ::-1].astype(np.float32) - 0.5 for c in find_contours(around, 0.5, fully_connected="low")]
    outer = [c for c in contours if cv2.contourArea(c, oriented=True) > 4]
    drawn = [cv2.approxPolyDP(c[:, None], 0.8, True)[:, 0] for c in outer]
    return [polygon.ravel().tolist() for polygon in drawn if len(polygon) >= 3]


if __name__ == "__main__":
    main(tyro.cli(Options))
