"""Labelled images of an object at random views and configurations, each made from its number alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import torch

from splatart_ns.bundle.articulated_splat import ArticulatedSplat, Picture
from splatart_ns.bundle.camera import SIZED_BY, Camera, bounding_sphere, orbit_camera
from splatart_ns.bundle.configurations import Configuration
from splatart_ns.capture.synthesis_options import MOST_PIXELS, MOST_STATES
from splatart_ns.choices import Views
from splatart_ns.errors import InputError

_PLASTIC = 1.32471795724474602596
"""The root of x^3 = x + 1: multiples of 1/x and 1/x^2 cover a square evenly, however many there are (M. Roberts, The
Unreasonable Effectiveness of Quasirandom Sequences, 2018)."""
_FREE = 0.25
"""How far the values of all states may be shifted, in distances between them: the less, the further two states are
apart."""


@dataclass(frozen=True)
class DatasetOptions:
    """What images are made."""

    states: int = 2
    """How many configurations. Image i shows state i % states."""
    resolution: int = 256
    """Pixels along each side."""
    views: Views = "sphere"
    """See the object from everywhere, or from above (+z) only."""
    seed: int = 0


@dataclass(frozen=True)
class Sample:
    """One labelled image."""

    index: int
    state: int
    q: Configuration
    camera: Camera
    rgba: np.ndarray
    """uint8 [H, W, 4], straight colours."""
    labels: np.ndarray
    """uint8 [H, W]: 0 background, else part ids."""
    depth: np.ndarray
    """float32 [H, W] along the optical axis, in the bundle's unit; 0 where nothing is seen."""


class Dataset:
    """Samples by number, 0 and up without end: the same object, options and number give the same sample.

    Every joint's range is cut into as many pieces as there are states, and each state has a value from another
    piece, evenly spaced from near one end of the range to near the other: any two states differ by more than a piece
    (of two, by 0.8 of the range), and many cover it (a Latin hypercube). A joint's freedoms are drawn apart.
    """

    def __init__(self, splat: ArticulatedSplat, options: DatasetOptions | None = None):
        """Raises InputError for options that make no sense."""
        self.splat, self.options = splat, options or DatasetOptions()
        for name, least, most in (("states", 1, MOST_STATES), ("resolution", 8, MOST_PIXELS), ("seed", 0, 2**128)):
            value = getattr(self.options, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise InputError(f"--{name} is {value!r}; give a whole number")
            if not least <= value <= most:
                rule = f"{least} or more" if value < least else f"{most} or less"
                raise InputError(f"--{name} is {value}; give {rule}")
            self.options = replace(self.options, **{name: int(value)})
        if self.options.views not in get_args(Views):
            raise InputError(f"--views is {self.options.views!r}; give {' or '.join(get_args(Views))}")
        some = [self.configuration(state) for state in range(min(self.options.states, SIZED_BY))]
        self.centre, self.radius = bounding_sphere(splat.bundle, some)
        """Of a sphere about the object in all states, which every image shows whole."""

    def configuration(self, state: int) -> Configuration:
        """The joint values of a state, from 0."""
        q: Configuration = {}
        states = self.options.states
        for number, (name, joint) in enumerate(self.splat.joints.items()):
            rng = np.random.default_rng([self.options.seed, 0, number])
            low, high = np.array(joint.ranges).T
            places = np.stack([rng.permutation(states) for _ in low], -1) + _FREE * rng.uniform(size=len(low))
            values = (low + (high - low) * places[state] / (states - 1 + _FREE)).tolist()
            q[name] = values if len(values) > 1 else values[0]
        return q

    def camera(self, index: int) -> Camera:
        """Where image `index` is taken from; the images of a state lie evenly around the object."""
        if index < 0:  # there is no end to count from
            raise IndexError(f"{index}: the images of a dataset are 0 and up")
        state, number = index % self.options.states, index // self.options.states
        start = np.random.default_rng([self.options.seed, 1, state]).uniform(size=2)
        height, turn = (start + (number + 1) / np.array([_PLASTIC, _PLASTIC**2])) % 1
        z = height if self.options.views == "hemisphere" else 1 - 2 * height
        size = self.options.resolution
        return orbit_camera(self.centre, self.radius, 2 * math.pi * turn, math.asin(z), size, size)

    def __getitem__(self, index: int) -> Sample:
        state = index % self.options.states
        q, camera = self.configuration(state), self.camera(index)
        picture = self.splat.render(camera, q)
        return Sample(
            index,
            state,
            q,
            camera,
            rgba=_rgba(picture),
            labels=picture.part_ids.byte().cpu().numpy(),
            depth=picture.depth.cpu().numpy(),
        )

    def samples(self, count: int, first: int = 0) -> Iterator[Sample]:
        """The samples `first` to `first + count - 1`."""
        for index in range(first, first + count):
            yield self[index]


def _rgba(picture: Picture) -> np.ndarray:
    alpha = picture.alpha[..., None].clamp(0, 1)
    straight = (picture.rgb / alpha.clamp_min(1e-6)).clamp(0, 1) * (alpha > 0)
    return (255 * torch.cat([straight, alpha], -1)).round().byte().cpu().numpy()
