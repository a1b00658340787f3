"""`splatart render`."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.progress import track

from splatart_ns.capture.synthesis_options import MOST_PIXELS
from splatart_ns.choices import Channel, Rasterizer, Views
from splatart_ns.cli.common import CONSOLE, choose_rasterizer
from splatart_ns.errors import InputError

if TYPE_CHECKING:  # it brings torch
    from splatart_ns.bundle import ArticulatedSplat, Bundle
    from splatart_ns.capture.capture import Frame


@dataclass
class Render:
    """Render a bundle in one configuration, in a sweep of each joint, along a trajectory, or as a labelled dataset."""

    bundle: Annotated[Path, tyro.conf.Positional]
    """Folder that `splatart fit` left."""
    output: Path
    """A folder for PNG frames or a dataset, or a .gif or .mp4 file."""
    configuration: Path | None = None
    """JSON file of joint values, as the viewer saves it; --set changes single ones."""
    set: Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction] = ()
    """Joint values, joint=value, or part=value for the joint that moves it: radians, or degrees as 30deg, or a length;
    joints of several freedoms take as many, lengths first: ball=10deg,0,5deg. Joints not named are as in state 0."""
    sweep: bool = False
    """Move one joint after the other over its range."""
    trajectory: Path | None = None
    """CSV file (commas or semicolons): a header of joints, and a row of values a frame; --set holds other joints."""
    dataset: int | None = None
    """Write a capture with ground truth: so many images with part labels and depth at random views and configurations.
    Run it again to go on, or with more to add some."""
    states: int = 2
    """Configurations of the dataset, each within the joints' ranges; the images are dealt out to them."""
    views: Views = "sphere"
    """See the object of the dataset from everywhere, or from above only."""
    seed: int = 0
    """Seed of the dataset."""
    channel: Channel = "rgb"
    """What to show."""
    frames: int = 60
    """Frames of each joint's sweep."""
    fps: float = 30.0
    """Frames per second of a film. A GIF counts hundredths of a second and shows each frame for two or more."""
    resolution: int = 512
    """Pixels along each side, without --data."""
    azimuth: float | None = None
    """Degrees of the camera about z; by default it faces the moving parts."""
    elevation: float = 25.0
    """Degrees of the camera above the xy plane."""
    data: Path | None = None
    """Folder of the capture, to look through one of its cameras instead: at its image's size and distortion."""
    camera: str = "0"
    """Number of that camera in its state, or its image's name."""
    state: str | None = None
    """Name of the state whose camera it is, the first by default; the object stays as --set has it."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Colour behind the object, 0 to 1."""
    rasterizer: Rasterizer = "auto"
    """As in `splatart fit`."""

    def run(self) -> None:
        from splatart_ns.bundle import load

        if self.sweep and self.trajectory is not None:
            raise InputError("--sweep and --trajectory are both given; choose one.")
        self._check_numbers()
        self._check_all_count()
        choose_rasterizer(self.rasterizer)
        splat = load(self.bundle)
        if self.dataset is not None:
            self._write_dataset(splat)
        else:
            self._write_frames(splat)

    def _check_numbers(self) -> None:
        wrong = {
            "frames": ("1 or more", self.frames < 1),
            "fps": ("a number above 0, at most 1000", not 0 < self.fps <= 1000),
            "resolution": (
                "1 or more" if self.resolution < 1 else f"{MOST_PIXELS} or less",
                not 1 <= self.resolution <= MOST_PIXELS,
            ),
            "azimuth": ("a finite angle", self.azimuth is not None and not math.isfinite(self.azimuth)),
            "elevation": ("-90 to 90", not -90 <= self.elevation <= 90),
            "background": ("three numbers from 0 to 1", not all(0 <= c <= 1 for c in self.background)),
        }
        for name, (mend, is_wrong) in wrong.items():
            if is_wrong:
                raise InputError(f"--{name} is {getattr(self, name)}; give {mend}.")

    def _check_all_count(self) -> None:
        """Refuse options that would change nothing."""
        film = self.output.suffix.lower() in (".gif", ".mp4") and not self.output.is_dir()
        shown = ("configuration", "set", "sweep", "trajectory", "data", "channel", "azimuth", "elevation", "background")
        unused = (
            (self.dataset is not None, "--dataset chooses what it shows;", (*shown, "fps")),
            (self.dataset is None, "--dataset is not given; give it, or", ("states", "views", "seed")),
            (self.channel == "accumulation", "--channel accumulation is shown on black;", ("background",)),
            (self.data is not None, "--data has cameras of its own;", ("resolution", "azimuth", "elevation")),
            (self.data is None, "--data is not given; give it, or", ("camera", "state")),
            (not self.sweep, "--sweep is not given; give it, or", ("frames",)),
            (not film, f"--output {self.output} is no .gif or .mp4; give one, or", ("fps",)),
        )
        defaults = {field.name: field.default for field in fields(self)}
        for applies, why, names in unused:
            given = [f"--{name}" for name in names if getattr(self, name) != defaults[name]]
            if applies and given:
                raise InputError(f"{why} leave out {' and '.join(given)}.")

    def _write_dataset(self, splat: ArticulatedSplat) -> None:
        from splatart_ns.bundle.dataset import Dataset, DatasetOptions
        from splatart_ns.bundle.dataset_capture import write_dataset

        samples = Dataset(splat, DatasetOptions(self.states, self.resolution, self.views, self.seed))
        told = write_dataset(samples, self.output, self.dataset, lambda left: track(left, "Images", console=CONSOLE))
        if not told:
            CONSOLE.print("note: no ground_truth.json, which cannot tell screws and joints of several freedoms")
        print(f"Capture: {self.output}")

    def _write_frames(self, splat: ArticulatedSplat) -> None:
        from splatart_ns.bundle import animation, configurations
        from splatart_ns.bundle import camera as cameras
        from splatart_ns.bundle.frame_camera import FrameView

        bundle, base = splat.bundle, {}
        if self.configuration is not None:
            base = configurations.read_configuration(self.configuration, bundle)
        held = configurations.parse_settings(sum(self.set, ()), bundle)
        base |= held
        if self.sweep and not any(configurations.sweep(bundle, {}, 1)):
            raise InputError(f"{self.bundle}: has no joint that moved, for --sweep to show; leave it out.")
        if self.trajectory is not None:
            rows = configurations.read_trajectory(self.trajectory, bundle)
            if both := held.keys() & rows[0].keys():
                raise InputError(f"{self.trajectory}: moves '{min(both)}', which --set holds; leave out one of them.")
            path = [base | q for q in rows]
        else:
            path = configurations.sweep(bundle, base, self.frames) if self.sweep else [base]
        seen = None
        if self.data is not None:
            seen = FrameView(self._frame(bundle))
            view = seen.camera
        else:
            degrees = self.azimuth
            azimuth = cameras.front_azimuth(bundle) if degrees is None else math.radians(degrees)
            sphere, elevation = cameras.bounding_sphere(bundle, path), math.radians(self.elevation)
            view = cameras.orbit_camera(*sphere, azimuth, elevation, self.resolution, self.resolution)
        images = animation.render_frames(splat, path, view, self.channel, self.background)
        if seen is not None:
            images = map(seen.as_taken, images)
        print(f"{animation.write_frames(images, self.output, self.fps)} frames: {self.output}")

    def _frame(self, bundle: Bundle) -> Frame:
        """Whose camera is looked through, in the bundle's world."""
        from splatart_ns.bundle.frame_camera import find_frame
        from splatart_ns.bundle.vantage import in_canonical_world
        from splatart_ns.capture.formats import load_capture

        capture = load_capture(self.data)
        if self.state is not None:  # the first one's world is the bundle's
            if len(capture.states) != len(bundle.states):
                raise InputError(f"{self.data}: has other states than the bundle; give the capture it was fitted to.")
            capture = in_canonical_world(capture, bundle)
        return find_frame(capture, self.camera, self.state)
