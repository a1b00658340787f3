"""Full images with alpha and part labels, for one state of a capture."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from splatart_ns.capture.capture import UNLABELLED, Capture, State
from splatart_ns.capture.hull import POSES_MEND, carve, contradiction, silhouette
from splatart_ns.capture.seen_surface import SeenSurface, measured_surface
from splatart_ns.capture.view import View, Window, load_points, load_view, load_views
from splatart_ns.errors import InputError
from splatart_ns.machine import num_cores
from splatart_ns.plugin.dataparser import SplatartDataParserConfig
from splatart_ns.stages.exposure import at_gain
from splatart_ns.stages.hull import EXACT, Hull, SeedPoints, seed_points, seen_surface, slack, visual_hull
from splatart_ns.stages.silhouette import with_silhouette
from splatart_ns.stages.surroundings import surrounding_points

NEARLY = 0.005
"""A scale factor is 1 / n if its n-fold is so near 1: 0.333 is 1 / 3."""
LEAST_SCALE = 0.001
"""Smaller images would have no pixels to speak of."""


class CaptureDataset(InputDataset):
    """Frames of one state. Frames may lack labels: their `semantics` are all 255."""

    exclude_batch_keys_from_device = [*InputDataset.exclude_batch_keys_from_device, "semantics"]

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0):
        """Raises `InputError` unless the scale factor is nearly 1 / n."""
        self.downscale = round(1 / scale_factor) if LEAST_SCALE <= scale_factor <= 1 else 0
        """How many times smaller than the files images are looked at."""
        if not abs(self.downscale * scale_factor - 1) <= NEARLY:
            raise InputError(
                f"--pipeline.datamanager.camera-res-scale-factor is {scale_factor}; give 1 / n with a whole n, as 1, "
                f"0.5, 0.333 or 0.25, and at least {LEAST_SCALE}."
            )
        super().__init__(dataparser_outputs, 1 / self.downscale)
        # As the images are; nerfstudio's may be a pixel smaller, by rounding.
        given = dataparser_outputs.cameras
        self.cameras.width, self.cameras.height = given.width // self.downscale, given.height // self.downscale

    def get_view(self, image_idx: int) -> View:
        """One frame's pixels, undistorted."""
        metadata = self._dataparser_outputs.metadata
        return load_view(metadata["frames"][image_idx], metadata["normalization"], self.downscale)

    @cached_property
    def views(self) -> list[View]:
        """All frames' pixels, for who needs them again and again."""
        with ThreadPoolExecutor(num_cores()) as pool:
            return list(pool.map(self.get_view, range(len(self))))

    def __getitem__(self, image_idx: int) -> dict[str, Any]:
        """As `get_data`, with the image over white, as renders are, for who shows it: ns-render and the viewer."""
        data = self.get_data(image_idx)
        rgb, alpha = data["image"][..., :3], data["image"][..., 3:]
        if alpha.shape[-1] == 1:
            data["image"] = rgb * alpha + 1 - alpha
        return data

    def get_data(self, image_idx: int, image_type: str = "float32") -> dict[str, Any]:
        """image [H, W, 3 or 4] (the silhouette as alpha, where there is one), semantics [H, W, 1], mask [H, W, 1]."""
        view = self.views[image_idx] if "views" in self.__dict__ else self.get_view(image_idx)
        image = view.rgb if view.alpha is None else torch.cat([view.rgb, view.alpha[..., None]], dim=-1)
        labels = torch.full(view.rgb.shape[:2], UNLABELLED, dtype=torch.uint8) if view.labels is None else view.labels
        data = {
            "image_idx": image_idx,
            "image": image.clone() if image_type == "uint8" else image.float() / 255,
            "semantics": labels[..., None].long(),
        }
        if view.mask is not None:
            data["mask"] = view.mask[..., None]
        return data


@dataclass
class SplatartDatamanagerConfig(FullImageDatamanagerConfig):
    """Caches all images of one state."""

    _target: type = field(default_factory=lambda: SplatartDatamanager)
    seed_gaussians: int = 0
    """Most points inside the silhouettes to start Gaussians from; small objects get fewer. And, where images are
    opaque, at most so many on what surrounds the object, from the capture's point cloud if there is one. Where
    silhouettes leave no hull, Gaussians start from that cloud."""
    seed: int = 0
    """Seed of those points."""


class SplatartDatamanager(FullImageDatamanager[CaptureDataset]):
    """Full images of one state of a capture, and points to start Gaussians from."""

    config: SplatartDatamanagerConfig

    def __init__(self, config: SplatartDatamanagerConfig, *args, test_mode: str = "val", **kwargs):
        if not isinstance(config.dataparser, SplatartDataParserConfig):
            raise InputError(
                f"The data parser is {type(config.dataparser).__name__}, which tells no states and parts; leave it out "
                "of the command, or name splatart-capture, which reads nerfstudio's transforms.json too."
            )
        super().__init__(config, *args, test_mode=test_mode, **kwargs)
        self.slack = EXACT
        """By how much the silhouettes contradict each other."""
        self.found = SeenSurface.nothing()
        """Of the object's surface, by the frames' depth or stereo, where its silhouettes are known."""
        self.gains: Tensor | None = None
        """How many times brighter than their mean the training frames are, by channel [N, 3]: they come evened."""
        self.voxel = 0.0
        """Side of a voxel of the silhouettes' hull."""
        self.outlined: Hull | None = None
        """That of the frames with an outline, where others have none: the object may be there."""
        if config.seed_gaussians > 0 and test_mode == "val":  # otherwise a checkpoint brings the Gaussians
            self._add_seed_points()

    @property
    def capture(self) -> Capture:
        return self.dataparser.capture

    @cached_property
    def measured(self) -> SeenSurface:
        """What the frames' own depth tells."""
        return measured_surface(self.train_dataset.views)

    @cached_property
    def _trusted_views(self) -> list[View]:
        return self.measured.trusted_views()

    def _add_seed_points(self) -> None:
        """Put points where VanillaPipeline looks for them; none if no image says where the object is."""
        state = self.capture.states[self.dataparser.config.state]
        generator = torch.Generator().manual_seed(self.config.seed)
        count, num_parts = self.config.seed_gaussians, len(self.capture.parts)
        points = None
        if state.points is not None:
            points = SeedPoints.without_normals(*load_points(state.points, self.capture.normalization, state.placement))
        views = self.train_dataset.views
        if any(view.alpha is None for view in views):
            outlined = [v for view in views if (v := with_silhouette(view)) is not None]
            around = surrounding_points(views, count, generator) if points is None else points.drawn(count, generator)
            hull = self.outlined = visual_hull(outlined) if outlined else None
            if hull is None:
                self._require_agreement(state)
            else:
                points = seed_points(outlined, num_parts, count, generator, hull, seen_surface(outlined, *hull))
                self.train_dataset.metadata["points3D_inside"] = len(points.xyz)
                points = points.joined(around)
                self.train_dataset.metadata["points3D_around"] = len(around.xyz)
        else:
            self.slack, hull = slack(views)
            if hull is None:
                self._require_agreement(state)
            # A cloud of structure from motion has most of its points around the object, and few on it.
            if hull is not None:
                self.found, self.voxel = seen_surface(views, *hull), hull[1]
                points = seed_points(views, num_parts, count, generator, hull, self.found)
                self.train_dataset.metadata["points3D_inside"] = len(points.xyz)
        if points is not None:
            self.train_dataparser_outputs.metadata.update(points3D_xyz=points.xyz, points3D_rgb=points.rgb)
            self.train_dataset.metadata["points3D_normals"] = points.normals

    def _require_agreement(self, state: State) -> None:
        """Raise `InputError` where most silhouettes of a state have no point in common in the place where it looks."""
        there = replace(self.capture, normalization=state.normalization())
        views = load_views(there, state, downscale=self.train_dataset.downscale)
        known = [view for view in views if (mask := silhouette(view)) is not None and mask.any() and not mask.all()]
        if len(known) > 2 and (found := contradiction(carve(known))) is not None:
            raise InputError(f"{self.capture.path / state.name}: {found}; {POSES_MEND}.")

    def next_train(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """A training frame and its camera: the piece around the object, where the image says which that is.

        The camera's metadata have the `whole` width and height, the data which `share` of its pixels the piece has.
        Where the frame has a depth, the data have what of it others confirm [H, W], else 0.
        """
        camera, data = super().next_train(step)
        left, top, right, bottom = self._windows[data["image_idx"]]
        depth = self._trusted_views[data["image_idx"]].depth
        if depth is not None:
            data["depth"] = depth[top:bottom, left:right]
            camera.metadata["depth"] = True
        width, height = int(camera.width), int(camera.height)
        camera.metadata["whole"] = width, height
        data["share"] = (right - left) * (bottom - top) / (width * height)
        camera.cx, camera.cy = camera.cx - left, camera.cy - top
        camera.width, camera.height = (torch.full_like(camera.width, x) for x in (right - left, bottom - top))
        for name in ("image", "semantics", "mask"):
            if name in data:
                data[name] = data[name][top:bottom, left:right]
        if self.gains is not None:
            image = data["image"]
            evened = at_gain(image[..., :3], self.gains[data["image_idx"]])
            data["image"] = torch.cat([evened, image[..., 3:]], -1)
        return camera, data

    @cached_property
    def _windows(self) -> list[Window]:
        return [view.object_window() for view in self.train_dataset.views]

    def _load_images(self, split, cache_images_device):
        # Pinning needs an accelerator; without one "cpu" and "gpu" are the same memory anyway.
        return super()._load_images(split, cache_images_device if torch.cuda.is_available() else "gpu")
