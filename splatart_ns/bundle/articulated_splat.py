"""An object of Gaussians with joints, to be posed and rendered."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatart_ns.bundle.bundle import Bundle, Joint
from splatart_ns.bundle.camera import Camera, bounding_sphere
from splatart_ns.bundle.configurations import movable_joints
from splatart_ns.bundle.folder import load_bundle
from splatart_ns.bundle.numbers import as_float64
from splatart_ns.bundle.posing import (
    JointValue,
    configured_motions,
    moved_splat,
    normalized,
    observed_values,
    part_features,
)
from splatart_ns.capture.capture import Normalization
from splatart_ns.errors import InputError, first_line
from splatart_ns.geometry.camera import viewmat_from_opengl
from splatart_ns.rasterize.rasterization import default_device
from splatart_ns.rasterize.render import Rendering, render

_AT_REST: Mapping[str, JointValue] = {}
_BRIGHTEST = 8.0
"""Colours are below it: those of renderings exceed 1 a little, and those of 0 to 255 by far."""


@dataclass(frozen=True)
class Picture:
    """What cameras see; without the leading dimension where neither cameras nor configurations are batched."""

    rgb: Tensor
    """Colours over black [B, H, W, 3], 0 to 1: multiplied by alpha. Strong lights may exceed 1 a little."""
    alpha: Tensor
    """How much of each pixel the object covers [B, H, W], 0 to 1."""
    depth: Tensor | None
    """Along the optical axis [B, H, W], in the bundle's unit; 0 where nothing is seen. None if not asked for."""
    part_shares: Tensor | None
    """How much of each pixel each part covers [B, H, W, P]; their sum is alpha. None if not asked for."""
    ids: Tensor
    """The parts' label ids [P]."""

    def over(self, background: Tensor | np.ndarray | Sequence[float]) -> Tensor:
        """Colours [B, H, W, 3] before a background [3] or an image [B, H, W, 3], clamped to 0..1.

        Raises InputError for a background of another shape, or of no colours (0 to 1, and a little beyond).
        """
        try:
            behind = as_float64(background).to(self.rgb)
            fits = torch.broadcast_shapes(behind.shape, self.rgb.shape) == self.rgb.shape and behind.shape[-1:] == (3,)
        except (TypeError, ValueError, OverflowError, RuntimeError):
            fits = False
        if not fits:
            raise InputError(f"the background is no colour [3] and no image {list(self.rgb.shape)}; give one of them")
        if not bool((behind.abs() < _BRIGHTEST).all()):
            extreme = float(behind.flatten()[behind.abs().argmax()])
            raise InputError(f"the background has a number of {extreme:g}; give colours of 0 to 1")
        return (self.rgb + (1 - self.alpha[..., None]) * behind).clamp(0, 1)

    @property
    def part_ids(self) -> Tensor:
        """The label id of the part that covers most of each pixel [B, H, W], int64; 0 where most is background."""
        if self.part_shares is None:
            raise InputError("the picture has no part labels; render it with labels=True")
        return predicted_parts(self.alpha[..., None], self.part_shares, self.ids)


def predicted_parts(accumulation: Tensor, features: Tensor, ids: Tensor) -> Tensor:
    """The likeliest part id [..., H, W] of rendered accumulation [..., H, W, 1] and part shares [..., H, W, P].

    `ids` [P] are the ids of the parts; 0 where most is background.
    """
    shares = torch.cat([1 - accumulation, features], dim=-1)
    return torch.cat([ids.new_zeros(1), ids])[shares.argmax(-1)]


class ArticulatedSplat:
    """A bundle in any configuration.

    A configuration `q` gives joints, by their names or those of the parts that they move, their values, as numbers,
    lists, arrays or tensors: radians or lengths, 0 where state 0 has the joint, [] or [B] for a joint of one freedom,
    [D] or [B, D] for one of D (`Joint.values` tells their order). Joints that it does not name are at 0. Values beyond
    the observed limits are taken.
    """

    def __init__(self, bundle: Bundle, device: torch.device | str | None = None):
        """`device`: where images are made; by default CUDA, where there is any and the chosen rasterizer runs there.

        Raises InputError where there is no such device.
        """
        self.bundle = bundle
        try:
            self.device = torch.device(device or default_device())
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:  # of a torch without CUDA the second
            raise InputError(f"the device '{device}' cannot be used ({first_line(error)}); give 'cpu'") from error
        parts = [replace(part, splat=part.splat.to(self.device)) for part in bundle.parts]
        self._on_device = replace(bundle, parts=parts)
        self._one_hot = part_features(bundle).to(self.device)
        self.centre, self.radius = bounding_sphere(
            bundle, [observed_values(bundle, s) for s in range(len(bundle.states))]
        )
        """Of a sphere about the object in the observed states: [3] in the canonical frame, and a length."""
        self.normalization = Normalization(self.centre, 1 / self.radius)
        """Brings the object to a radius of 1 about the origin, to render it: the near plane is a fixed length."""

    @property
    def joints(self) -> dict[str, Joint]:
        """The joints that can be moved, by name, parents before children."""
        return movable_joints(self.bundle)

    @property
    def part_names(self) -> list[str]:
        """In order of the parts' ids, as in `Picture.part_shares`."""
        return self.bundle.part_names

    def link_poses(self, q: Mapping[str, JointValue] = _AT_REST) -> dict[str, Tensor]:
        """T_world_link [4, 4], or [B, 4, 4] for a batch, float64, of each part by name.

        It moves the part's points from the canonical frame (the world at state 0, where its Gaussians are stored) to
        where they are in the configuration. The root stays. Differentiable in `q`.

        Raises:
            InputError: an unknown joint, values of a wrong shape, not finite or 1e18 and more, batches of different
                sizes.
        """
        return configured_motions(self.bundle, q)

    def render(
        self,
        camera: Camera,
        q: Mapping[str, JointValue] = _AT_REST,
        *,
        parts: Collection[str] | None = None,
        depth: bool = True,
        labels: bool = True,
    ) -> Picture:
        """What the camera sees in a configuration, float32 on `device`; differentiable in `q`.

        Args:
            camera: One, or a batch of B.
            q: One configuration, or a batch of B; two batches go in pairs.
            parts: Names of those that are rendered; all by default.
            depth, labels: Whether to render them; without, it is faster.

        Raises:
            InputError: as `link_poses`; an unknown part; what is no camera.
        """
        if not isinstance(camera, Camera):
            raise InputError(f"the camera is {camera!r}; give a Camera")
        shown = self._shown(parts)
        motions = self.link_poses(q)
        posed = motions[self.bundle.root].shape[:-2]
        if len(posed) > 1 or len({*posed, *camera.batch} - {1}) > 1:
            found = f"configurations {list(posed)} and cameras {list(camera.batch)}"
            raise InputError(f"the batches of {found} do not go together; give B of both, or B of one")
        if 0 in (*posed, *camera.batch):
            raise InputError("the batch is empty; give one configuration and one camera or more")

        def seen(motions: Mapping[str, Tensor], viewmats: Tensor, Ks: Tensor) -> Rendering:
            splat = normalized(moved_splat(self._on_device, motions), self.normalization).select(shown)
            one_hot = self._one_hot[shown] if labels else None
            size = camera.width, camera.height
            return render(splat, viewmats, Ks, *size, features=one_hot, with_depth=depth)

        batch = torch.broadcast_shapes(posed, camera.batch)
        viewmats, Ks = (x.expand(*(batch or (1,)), *x.shape[-2:]) for x in self._tensors(camera))
        if posed:
            motions = {name: T.expand(*batch, 4, 4) for name, T in motions.items()}
            each = [
                seen({name: T[i] for name, T in motions.items()}, viewmats[i, None], Ks[i, None])
                for i in range(batch[0])
            ]
        else:
            each = [seen(motions, viewmats, Ks)]
        return self._picture(each, batch)

    def _shown(self, parts: Collection[str] | None) -> Tensor:
        """Which Gaussians [N] belong to these parts."""
        names = self.part_names
        wanted = {parts} if isinstance(parts, str) else set(names if parts is None else parts)
        if unknown := wanted - set(names):
            raise InputError(f"no part is called {', '.join(sorted(map(str, unknown)))}; there are {', '.join(names)}")
        return self._one_hot @ torch.tensor([name in wanted for name in names]).to(self._one_hot) > 0

    def _tensors(self, camera: Camera) -> tuple[Tensor, Tensor]:
        T = camera.T_world_camera.clone()
        T[..., :3, 3] = (T[..., :3, 3] - torch.from_numpy(self.centre)) / self.radius
        return viewmat_from_opengl(T).float().to(self.device), camera.K.float().to(self.device)

    def _picture(self, each: list[Rendering], batch: tuple[int, ...]) -> Picture:
        def joined(images: list[Tensor]) -> Tensor:
            image = torch.cat(images)
            return image if batch else image[0]

        first = each[0]
        return Picture(
            rgb=joined([r.rgb for r in each]),
            alpha=joined([r.accumulation[..., 0] for r in each]),
            depth=None if first.depth is None else joined([r.depth[..., 0] for r in each]) * self.radius,
            part_shares=None if first.features is None else joined([r.features for r in each]),
            ids=torch.tensor([part.id for part in self.bundle.parts], device=self.device),
        )


def load(folder: Path | str, device: torch.device | str | None = None) -> ArticulatedSplat:
    """The object in a bundle's folder. Raises InputError where that cannot be read."""
    if not isinstance(folder, str | os.PathLike):
        raise InputError(f"the bundle's folder is {folder!r}; give its path")
    return ArticulatedSplat(load_bundle(Path(folder)), device)
