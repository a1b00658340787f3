"""Part labels of frames that nobody labelled, rendered from the fitted object, for review and for the next fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.frame_camera import pinhole_pixels
from splatart_ns.bundle.posing import moved_splat, normalized, observed_motions, part_features
from splatart_ns.bundle.vantage import in_canonical_world
from splatart_ns.capture.capture import UNLABELLED, Capture, Frame, Normalization
from splatart_ns.capture.images import read_image, read_sized, write_png
from splatart_ns.capture.mask_export import mask_paths, write_mask_classes
from splatart_ns.errors import InputError
from splatart_ns.files import new_folder, replacing
from splatart_ns.geometry.camera import viewmat_from_opengl
from splatart_ns.rasterize.render import render
from splatart_ns.splats.palette import part_colours
from splatart_ns.splats.splat import Splat

_SURE = 0.6
"""A pixel is labelled where a part, or the background, covers so much of it."""


@dataclass(frozen=True)
class RenderedLabels:
    """What was written for a frame."""

    state: str
    frame: Frame
    doubtful: float
    """The share of the object's pixels that are left unlabelled: look at the frames first that have most."""


@torch.no_grad()
def write_labels(
    bundle: Bundle, capture: Capture, output: Path, device: torch.device | str = "cpu"
) -> list[RenderedLabels]:
    """Write the labels of all frames without any, the most doubtful first in what is returned.

    `output/labels/STATE/FRAME.png` and `output/labels/_classes.csv` are an export as `import_labels` reads it, at the
    images' own size and distortion; `output/overlays/STATE/FRAME.jpg` are the images in the parts' colours. What
    stands before the object is not known, so that its pixels are labelled as the part behind.

    Raises:
        InputError: The bundle has other states or parts than the capture; the folder is in use; every frame is
            labelled; an image cannot be read.
    """
    if len(bundle.states) != len(capture.states) or {p.id: p.name for p in bundle.parts} != capture.parts:
        raise InputError(
            f"{capture.path}: has other states or parts than the bundle; give the capture it was fitted to."
        )
    capture = in_canonical_world(capture, bundle)
    ids = torch.tensor([0, *(part.id for part in bundle.parts)])
    features, colours = part_features(bundle).to(device), part_colours(max(capture.parts)).numpy()
    done = []
    with new_folder(output) as folder:
        for k, state in enumerate(capture.states):
            splat = normalized(moved_splat(bundle, observed_motions(bundle, k)), capture.normalization).to(device)
            paths = mask_paths(state)
            for frame in state.frames:
                if frame.labels is not None:
                    continue
                name = paths[frame.name]
                shares = _part_shares(splat, features, frame, capture.normalization)
                most, place = shares.max(-1)
                labels = torch.where(most >= _SURE, ids[place], UNLABELLED).numpy().astype(np.uint8)
                write_png(folder / "labels" / name, labels)
                _write_overlay(folder / "overlays" / name.with_suffix(".jpg"), frame, labels, colours)
                object_ = labels != 0
                doubtful = float((labels == UNLABELLED).sum() / max(1, object_.sum()))
                done.append(RenderedLabels(state.name, frame, doubtful))
        if not done:
            raise InputError(f"{capture.path}: every frame is labelled; there is nothing to add.")
        write_mask_classes(folder / "labels/_classes.csv", capture.parts)
    return sorted(done, key=lambda one: -one.doubtful)


def _part_shares(splat: Splat, features: Tensor, frame: Frame, normalization: Normalization) -> Tensor:
    """How much of each pixel of a frame, as the camera took it, is background and each part: [H, W, 1 + P]."""
    camera = frame.camera
    T = torch.from_numpy(normalization.camera_to_normal(frame.T_world_camera)).to(splat.means)
    pixels, wide = pinhole_pixels(camera)
    column, row = torch.from_numpy(np.floor(pixels).astype(np.int64)).unbind(-1)
    rendering = render(
        splat,
        viewmat_from_opengl(T[None, :3]),
        torch.from_numpy(wide.K).to(splat.means)[None],
        wide.width,
        wide.height,
        features=features,
        with_depth=False,
        sh_degree=0,
    )
    shares = torch.cat([1 - rendering.accumulation[0], rendering.features[0]], dim=-1).cpu()
    return shares[row, column]


def _write_overlay(path: Path, frame: Frame, labels: np.ndarray, colours: np.ndarray) -> None:
    """The image with its parts tinted and outlined, what is doubtful white."""
    image = read_sized(frame.image, read_image, frame.camera)[..., :3].astype(np.float32)
    for part in set(np.unique(labels).tolist()) - {0}:
        colour = 255.0 * (np.ones(3) if part == UNLABELLED else colours[part])
        mask = (labels == part).astype(np.uint8)
        edge = mask - cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=0)
        image[mask > 0] = 0.6 * image[mask > 0] + 0.4 * colour
        image[edge > 0] = colour
    with replacing(path) as temporary:
        if not cv2.imwrite(str(temporary), image[..., ::-1].astype(np.uint8)):
            raise InputError(f"{path}: the image cannot be written; check the space on the disk.")
