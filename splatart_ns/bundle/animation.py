"""Pictures of a bundle in motion: rendering configurations, writing frames, GIFs and videos."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from splatart_ns.bundle.articulated_splat import ArticulatedSplat, Picture
from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.camera import Camera, bounding_sphere
from splatart_ns.bundle.configurations import Configuration
from splatart_ns.choices import Channel
from splatart_ns.errors import InputError
from splatart_ns.files import replacing
from splatart_ns.splats.palette import part_colours

_FILMS = {".gif", ".mp4"}
"""How the names of films end that can be written."""
_OTHER_FORMATS = {".png", ".apng", ".jpg", ".jpeg", ".webp", ".avif", ".bmp", ".tif", ".tiff", ".exr", ".svg", ".pdf"}
_OTHER_FORMATS |= {".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".ogv", ".flv"}
"""Of pictures and films; whoever names one expects no folder."""


def render_frames(
    splat: ArticulatedSplat,
    configurations: Sequence[Configuration],
    camera: Camera,
    output: Channel = "rgb",
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Iterator[np.ndarray]:
    """Render one frame per configuration, uint8 [H, W, 3] RGB.

    `background` is in 0..1. Depth is shown in colours, red near and blue far, over the depths that the object can have;
    parts have the colours of `bundle_colours`; accumulation is grey.
    """
    centre, radius = bounding_sphere(splat.bundle, configurations)
    distance = float(np.linalg.norm(camera.T_world_camera[:3, 3].numpy() - centre))
    depths = (distance - radius, distance + radius)
    colours = bundle_colours(splat.bundle)
    for q in configurations:
        picture = splat.render(camera, q, depth=output == "depth", labels=output == "parts")
        image = _image(picture, output, colours, torch.tensor(background), depths)
        yield (255 * image).round().byte().numpy()


def _image(
    picture: Picture, output: Channel, colours: Tensor, background: Tensor, depths: tuple[float, float]
) -> Tensor:
    """What is shown [H, W, 3] in 0..1."""
    alpha = picture.alpha.cpu()
    if output == "accumulation":
        return alpha[..., None].expand(-1, -1, 3)
    if output == "depth":
        near, far = depths
        share = ((far - picture.depth.cpu()) / (far - near)).clamp(0, 1)
        shown = cv2.applyColorMap((255 * share).round().byte().numpy(), cv2.COLORMAP_TURBO)[..., ::-1]
        picture = replace(picture, rgb=alpha[..., None] * torch.from_numpy(shown.copy()) / 255, alpha=alpha)
    elif output == "parts":
        picture = replace(picture, rgb=picture.part_shares.cpu() @ colours, alpha=alpha)
    return picture.over(background).cpu()


def bundle_colours(bundle: Bundle) -> Tensor:
    """The colour of each part [P, 3] in 0..1."""
    ids = torch.tensor([part.id for part in bundle.parts])
    return part_colours(int(ids.max()))[ids]


def write_frames(frames: Iterable[np.ndarray], path: Path, fps: float = 30.0) -> int:
    """Write frames [H, W, 3] RGB to `*.gif`, `*.mp4`, or as PNGs into a folder, which other paths are.

    Files appear under their names when they are whole. PNGs are `frame_0000.png` and so on; those of an earlier,
    longer run, which follow on these without a gap, are removed. Returns the number of frames.

    Raises:
        InputError: `path` is called as other pictures or films are, is a file where it should be a folder, or ffmpeg
            fails.
    """
    path = Path(path)
    suffix = "" if path.is_dir() else path.suffix.lower()
    if suffix == ".gif":
        return _write_gif(frames, path, fps)
    if suffix == ".mp4":
        return _write_mp4(frames, path, fps)
    if suffix in _OTHER_FORMATS:
        raise InputError(f"{path}: '{suffix}' cannot be written; give a .gif, an .mp4 or a folder")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; give a .gif, an .mp4 or a folder")
    return _write_pngs(frames, path)


def is_called_as_a_file(path: Path) -> bool:
    """Whether a path has the name of a picture or film, and is no folder in spite of it."""
    return path.suffix.lower() in _FILMS | _OTHER_FORMATS and not path.is_dir()


def _write_pngs(frames: Iterable[np.ndarray], folder: Path) -> int:
    count = 0
    for frame in frames:
        with replacing(folder / _frame_name(count)) as temporary:
            Image.fromarray(frame).save(temporary)
        count += 1
    stale = count
    while (folder / _frame_name(stale)).is_file():
        (folder / _frame_name(stale)).unlink()
        stale += 1
    return count


def _frame_name(number: int) -> str:
    return f"frame_{number:04d}.png"


def _write_gif(frames: Iterable[np.ndarray], path: Path, fps: float) -> int:
    # Browsers take less than two hundredths of a second for ten.
    count, each, images, hundredths, last = 0, max(100 / fps, 2), [], [], None
    for frame in frames:
        if last is None or not np.array_equal(frame, last):
            images.append(Image.fromarray(frame).quantize())
            hundredths.append(0.0)
        hundredths[-1] += each
        last, count = frame, count + 1
    # The count has 16 bits. Pillow would add up the times of frames that are alike, whatever that comes to.
    durations = [10 * min(round(time), 65535) for time in hundredths]
    with replacing(path) as temporary:
        images[0].save(temporary, save_all=True, append_images=images[1:], duration=durations, loop=0)
    return count


def _write_mp4(frames: Iterable[np.ndarray], path: Path, fps: float) -> int:
    count, writer = 0, None
    with replacing(path) as temporary:
        temporary.touch()  # where that cannot be, it says why
        try:
            for frame in frames:
                # Video has one colour sample for 2 x 2 pixels.
                height, width = frame.shape[:2]
                frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                with _ffmpeg_at(path):
                    if writer is None:
                        writer = _film_writer(temporary, frame, fps)
                    writer.send(np.ascontiguousarray(frame))
                count += 1
        finally:
            if writer is not None:
                writer.close()
        with _ffmpeg_at(path):  # which fails in silence, too
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(temporary.absolute()))
            if written < count:
                raise RuntimeError(f"{written} of {count} frames")
    return count


def _film_writer(path: Path, frame: np.ndarray, fps: float) -> Generator[None, np.ndarray, None]:
    """Takes frames like this one."""
    size = frame.shape[1], frame.shape[0]
    # A relative path with a colon would be a protocol's.
    writer = imageio_ffmpeg.write_frames(str(path.absolute()), size, fps=fps, quality=8, macro_block_size=2)
    writer.send(None)
    return writer


@contextmanager
def _ffmpeg_at(path: Path) -> Iterator[None]:
    """Turn what imageio-ffmpeg raises into an `InputError`."""
    try:
        yield
    except (OSError, RuntimeError, IndexError) as error:
        mend = "check the space on the disk and the ffmpeg of imageio-ffmpeg, or give a .gif or a folder"
        raise InputError(f"{path}: ffmpeg could not write it; {mend}") from error
