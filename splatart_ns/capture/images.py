"""Images, labels, masks and depths as arrays: reading, undistortion, downscaling.

All readers raise `InputError` when the file is missing, damaged or not of the kind that is asked for.
"""

from __future__ import annotations

import io
import math
import os
import struct
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image

from splatart_ns.capture.capture import UNLABELLED, Camera, CaptureError
from splatart_ns.errors import InputError
from splatart_ns.files import replacing

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"
_JPEG = b"\xff\xd8\xff"
_PNG_COLOUR_TYPES = {0: "grey", 2: "RGB", 3: "palette", 4: "grey and alpha", 6: "RGBA"}
_LABELS_MEND = "save the part ids themselves in one grey channel of 8 or 16 bits, without colours"
_HALF = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])  # OpenCV's pixel centres lie at integers
MAX_LABEL = UNLABELLED - 1
_WHITE = 250
"""Of 255; an object that soft edges leave darker is no wider than a pixel."""
_MOST_BYTES, _MOST_PIXELS = 1 << 30, 1 << 27


def read_image(path: Path) -> np.ndarray:
    """A colour image, uint8 [H, W, 3] RGB or [H, W, 4] RGBA with straight alpha.

    Grey images are repeated over the channels, 16-bit values are divided by 257.
    """
    pixels = _to_bytes(path, _decode(path, read_bytes(path)))
    if pixels.ndim == 2:
        return cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


def read_labels(path: Path) -> np.ndarray:
    """Part ids, uint8 [H, W]: 0 background, 1..254 parts, 255 unlabelled; from a PNG of 8 or 16 bits.

    They are the indices of a palette, as annotation tools write them, else the grey of one channel or of three.
    """
    data = read_bytes(path)
    if not data.startswith(_PNG) or len(data) < 33:
        raise CaptureError(path, "labels are not a PNG file", "save the part ids as a one-channel 8- or 16-bit PNG")
    bits, colour_type = data[24], data[25]
    kind = _PNG_COLOUR_TYPES.get(colour_type, f"colour type {colour_type}")
    labels = _decode(path, data)
    if kind == "palette":
        labels = _palette_indices(path, data, labels)
    elif kind == "RGB" and (labels == labels[..., :1]).all():
        labels = np.ascontiguousarray(labels[..., 0])
    elif kind != "grey" or bits < 8:
        raise CaptureError(path, f"labels are a PNG of {bits}-bit {kind}", _LABELS_MEND)
    if labels.dtype == np.uint16:
        if labels.max(initial=0) > UNLABELLED:
            raise CaptureError(
                path,
                f"label {labels.max()} is above the largest part id, {MAX_LABEL}",
                f"number the parts 1 to {MAX_LABEL} and write {UNLABELLED} where nothing is labelled",
            )
        labels = labels.astype(np.uint8)
    return labels


def read_mask(path: Path) -> np.ndarray:
    """The pixels that count, uint8 [H, W]: 255 where the file is not 0, as in nerfstudio, else 0."""
    return np.where(_mask_channel(path), np.uint8(255), np.uint8(0))


def read_silhouette(path: Path) -> np.ndarray:
    """How much of each pixel an object covers, uint8 [H, W], 255 for all of it.

    A file without white holds 0 and one other value, which is stretched to 255, so that no object is half transparent.
    """
    pixels = _mask_channel(path)
    silhouette = _to_bytes(path, pixels)
    if silhouette.max(initial=0) >= _WHITE:
        return silhouette
    values = np.unique(pixels).tolist()
    if len({*values} - {0}) > 1:
        told = values if len(values) <= 5 else [*values[:3], "...", values[-1]]
        found = f"the mask is nowhere white: its values are {', '.join(map(str, told))}"
        raise CaptureError(path, found, "write 255 where the object is and 0 elsewhere")
    return np.where(pixels, np.uint8(255), np.uint8(0))


def read_depth(path: Path, unit: float = 1e-3) -> np.ndarray:
    """Depth along the optical axis, float32 [H, W], 0 where unknown, in nerfstudio's convention.

    The file is a 16- or 32-bit one-channel image or a `.npy` array; both are multiplied by `unit`, the length of
    one count (nerfstudio's `depth_unit_scale_factor`: millimetres in a world of metres).
    """
    if path.suffix.lower() == ".npy":
        if not os.path.isfile(path):
            raise CaptureError(path, "the file does not exist", "add it or correct its path")
        try:  # mapped, so that a header that promises more than the file holds takes no memory
            depth = np.load(path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # numpy lets whatever its parsers meet through
            raise CaptureError(path, f"the depth cannot be read ({error})", "save it again with numpy.save") from None
        if not isinstance(depth, np.ndarray) or depth.dtype.kind not in "fiu":
            raise CaptureError(path, "the depth is not an array of numbers", "save it as float32 with numpy.save")
    else:
        depth = _decode(path, read_bytes(path))
        if depth.dtype == np.uint8:
            raise CaptureError(path, "the depth image has 8 bits", "save the depth as a 16-bit PNG in millimetres")
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.size > _MOST_PIXELS:
        raise CaptureError(path, f"the depth has the shape {depth.shape}", "save it with one channel")
    return np.nan_to_num(depth.astype(np.float32) * np.float32(unit), nan=0.0, posinf=0.0, neginf=0.0)


def depth_unit(farthest: float) -> float:
    """The length of one count of a depth image: the power of ten with which twice the farthest depth has 16 bits."""
    return 10.0 ** math.ceil(math.log10(2 * farthest / 65535))


def write_depth(path: Path, depth: np.ndarray, unit: float) -> None:
    """Write depth [H, W] as 16 bits, in counts of `unit`."""
    write_png(path, (depth / unit).round().clip(0, 65535).astype(np.uint16))


def write_png(path: Path, image: np.ndarray) -> None:
    """Write grey, BGR or BGRA pixels (uint8 or uint16), making the folder where it is missing."""
    with replacing(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", image)[1])


def read_sized(path: Path, reader: Callable[[Path], np.ndarray], camera: Camera) -> np.ndarray:
    """What `reader` reads, which must have the camera's size."""
    array = reader(path)
    height, width = array.shape[:2]
    if (width, height) != (camera.width, camera.height):
        found = f"it is {width}x{height} pixels, but its camera is {camera.width}x{camera.height}"
        mend = "resize the file"
        if (height, width) == (camera.width, camera.height):
            mend = "turn it on its side, as the pixels of its image are stored"
            if (turn := orientation(path)) > 1:
                found += f", and EXIF data turn it (orientation {turn})"
                mend = "turn its pixels so and take the orientation out, as `mogrify -auto-orient` does"
        raise CaptureError(path, found, f"{mend}, or correct w, h and the intrinsics")
    return array


def read_depth_for(path: Path, camera: Camera, unit: float = 1e-3) -> np.ndarray:
    """`read_depth` for a camera: sensors of depth have fewer pixels, of which each takes the nearest, as nerfstudio."""
    depth = read_depth(path, unit)
    height, width = depth.shape
    uneven = abs(width * camera.height - height * camera.width) > max(camera.height, camera.width)
    if uneven or depth.size == 0:
        raise CaptureError(
            path,
            f"the depth is {width}x{height} pixels, and not a smaller {camera.width}x{camera.height} as its camera",
            "cut the file to what the image shows",
        )
    return cv2.resize(depth, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image; of a PNG without decoding it."""
    data = read_bytes(path, 24)
    if data.startswith(_PNG) and len(data) == 24:
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    height, width = read_image(path).shape[:2]
    return width, height


def orientation(path: Path) -> int:
    """How an image's EXIF data ask to turn it: 1 not at all, 2 to 4 within its size, 5 to 8 on its side. Viewers and
    annotation tools do; COLMAP, nerfstudio and `read_image` take the pixels as they are stored."""
    exif = PIL.Image.Exif()
    try:
        with PIL.Image.open(path) as image:
            exif.load(image.info.get("exif"))
        turn = exif.get(PIL.ExifTags.Base.Orientation)
    except Exception:  # Pillow lets whatever its parsers meet through
        return 1
    return turn if turn in range(1, 9) else 1


def as_stored(shown: np.ndarray, turn: int) -> np.ndarray:
    """Pixels [H, W] of an image that was turned on its side, as an `orientation` of 5 to 8 asks, before it was."""
    stored = {5: shown.T, 6: np.rot90(shown), 7: np.rot90(shown.T, 2), 8: np.rot90(shown, -1)}
    return np.ascontiguousarray(stored[turn])


@lru_cache(maxsize=4096)
def undistorted_camera(camera: Camera) -> Camera:
    """The camera without distortion whose image `undistort` gives.

    As in nerfstudio's FullImageDatamanager: OpenCV's optimal new camera matrix without empty pixels (alpha = 0),
    cropped to its region of interest, found with pixel centres at integers. Raises `InputError` if no pixel is left.
    """
    if not camera.distorted:
        return camera
    try:
        new = _optimal_camera(camera)
        if _sees(camera, new):
            return new
    except cv2.error:  # OpenCV's assertions fail where nothing is left
        pass
    raise InputError(f"The distortion k1, k2, k3, k4, p1, p2 = {camera.distortion} leaves no image; correct it.")


def undistort(image: np.ndarray, camera: Camera) -> np.ndarray:
    """An image or mask [H, W] or [H, W, C] as `undistorted_camera(camera)` sees it, interpolated linearly.

    Colours are weighted by their alpha, so that what lies behind transparent pixels does not bleed in.
    """
    if not camera.distorted:
        return image
    u, v = _distorted_pixels(camera)
    return _filter(image, lambda x: cv2.remap(x, u, v, cv2.INTER_LINEAR))


def undistort_labels(labels: np.ndarray, camera: Camera, unknown: int = UNLABELLED) -> np.ndarray:
    """Labels or depths [H, W] as `undistorted_camera(camera)` sees them, by the nearest pixel, or `unknown`."""
    if not camera.distorted:
        return labels
    u, v = _distorted_pixels(camera)
    return cv2.remap(labels, u, v, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, unknown)


def undistorted_points(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Where the rays through pixel positions [N, 2] of a camera, distorted or not, meet the plane at depth 1 [N, 2]."""
    if not camera.distorted:
        return (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    points = pixels.reshape(-1, 1, 2).astype(np.float64)
    return cv2.undistortPointsIter(points, camera.K, _opencv_distortion(camera), None, None, criteria)[:, 0]


def downscale(image: np.ndarray, factor: int) -> np.ndarray:
    """The image's means over factor x factor pixels, colours weighted by their alpha; the remainder is cut off."""
    if factor == 1:
        return image
    h, w = image.shape[0] // factor, image.shape[1] // factor
    cut = image[: h * factor, : w * factor]
    return _filter(cut, lambda x: cv2.resize(x, (w, h), interpolation=cv2.INTER_AREA))


def downscale_labels(labels: np.ndarray, factor: int) -> np.ndarray:
    """The label, or depth, in the middle of each block of factor x factor pixels; they are never mixed."""
    h, w = labels.shape[0] // factor, labels.shape[1] // factor
    return np.ascontiguousarray(labels[factor // 2 :: factor, factor // 2 :: factor][:h, :w])


def read_bytes(path: Path, size: int = _MOST_BYTES + 1) -> bytes:
    """The first `size` bytes of a file, or all of at most 1 GiB."""
    if not os.path.isfile(path):
        raise CaptureError(path, "the file does not exist", _missing_mend(path))
    try:
        with open(path, "rb") as file:
            data = file.read(size)
    except OSError as error:
        raise CaptureError(path, f"the file cannot be read ({error.strerror})", "make it readable") from None
    if len(data) > _MOST_BYTES:
        raise CaptureError(path, "the file is larger than 1 GiB", "give a smaller one")
    return data


def _missing_mend(path: Path) -> str:
    if "\\" in path.name:
        return "write / for \\ in its path"
    # NeRF's synthetic scenes leave the suffix out.
    names = [path.with_name(path.name + suffix) for suffix in (".png", ".jpg")]
    given = next((name for name in names if os.path.isfile(name)), None)
    return f"write {given.suffix} after its path" if given is not None else "add it or correct its path"


def _decode(path: Path, data: bytes) -> np.ndarray:
    try:  # the size that the header promises, before OpenCV makes room for it
        width, height = PIL.Image.open(io.BytesIO(data)).size
    except PIL.Image.DecompressionBombError:
        width = height = 1 << 16
    except Exception:  # Pillow lets whatever its parsers meet through
        width = height = 0
    if width * height > _MOST_PIXELS:
        found = f"the image has more than {_MOST_PIXELS >> 20} mega pixels"
        raise CaptureError(path, found, "scale it down, and its intrinsics with it")
    # OpenCV fills the missing part of a cut-off JPEG with grey; its end marker must follow the first scan's start. Of a
    # cut-off PNG libpng writes lines of its own.
    cut_off = data.startswith(_JPEG) and data.find(b"\xff\xd9", _first_scan(data)) < 0
    cut_off |= data.startswith(_PNG) and _PNG_END not in data
    try:
        known = width > 0 and not cut_off
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if known else None
    except cv2.error:
        pixels = None
    if pixels is None:
        raise CaptureError(path, "the image is cut off, damaged or of an unknown kind", "copy or export it again")
    return pixels


def _first_scan(data: bytes) -> int:
    """Where the first scan of a JPEG starts: what comes before may hold a small picture with an end of its own."""
    at = 2
    while data[at : at + 1] == b"\xff" and (marker := data[at + 1 : at + 2]) != b"\xda":
        # Any number of FF may come before a marker.
        at += 1 if marker == b"\xff" else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return at


def _palette_indices(path: Path, data: bytes, shown: np.ndarray) -> np.ndarray:
    """The indices [H, W] of a PNG whose colours `shown` [H, W, 3 or 4] come from a palette."""
    try:
        with PIL.Image.open(io.BytesIO(data)) as image:
            indices, palette = np.array(image), np.reshape(image.getpalette(), (-1, 3))
    except Exception:  # Pillow lets whatever its parsers meet through
        raise CaptureError(path, "the palette is damaged", "export the labels again") from None
    # Programs that shrink files give greys a palette, too, in an order of their own.
    if (palette == palette[:, :1]).all() and (shown[..., 0] != indices).any():
        raise CaptureError(path, "labels are a palette PNG of greys that are not their indices", _LABELS_MEND)
    return indices


def _mask_channel(path: Path) -> np.ndarray:
    """The channel [H, W] that holds a mask: the grey, or the alpha where it varies and the colour does not."""
    pixels = _decode(path, read_bytes(path))
    if pixels.ndim == 2:
        return pixels
    colour, alpha = pixels[..., :3], pixels[..., -1]
    if pixels.shape[2] == 4 and np.ptp(alpha) > 0:
        shown = colour[alpha > 0]
        if (shown != shown[0]).any():
            raise CaptureError(path, "the mask has colours and an alpha channel", "save it with one grey channel")
        return np.ascontiguousarray(alpha)
    if not (colour == colour[..., :1]).all():
        raise CaptureError(path, "the mask is a colour image", "save it with one grey channel")
    return np.ascontiguousarray(colour[..., 0])


def _to_bytes(path: Path, pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise CaptureError(path, f"the image holds {pixels.dtype} values", "save it with 8 or 16 bits a channel")
    return pixels


def _filter(image: np.ndarray, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A linear filter of an image; of RGBA on colours that are multiplied by alpha, given back straight."""
    if image.ndim == 2 or image.shape[2] == 3:
        return function(image)
    alpha = image[..., 3:].astype(np.float32)
    filtered = function(np.concatenate([image[..., :3] * alpha, alpha], axis=2))
    colour = filtered[..., :3] / np.maximum(filtered[..., 3:], 1e-6)
    return np.rint(np.concatenate([colour, filtered[..., 3:]], axis=2)).clip(0, 255).astype(np.uint8)


def _optimal_camera(camera: Camera) -> Camera:
    K, (x, y, width, height) = cv2.getOptimalNewCameraMatrix(
        camera.K - _HALF, _opencv_distortion(camera), (camera.width, camera.height), 0
    )
    return Camera(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2] + 0.5 - x),
        cy=float(K[1, 2] + 0.5 - y),
        width=width,
        height=height,
    )


@lru_cache(maxsize=16)
def _distorted_pixels(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Where the pixels of `undistorted_camera(camera)` lie in the distorted image: u, v float32 [H, W]."""
    new = undistorted_camera(camera)
    return cv2.initUndistortRectifyMap(
        camera.K - _HALF, _opencv_distortion(camera), None, new.K - _HALF, (new.width, new.height), cv2.CV_32FC1
    )


def _sees(camera: Camera, new: Camera) -> bool:
    """Whether the new camera has pixels, and a grid of their rays falls into the distorted image, or nearly."""
    if min(new.width, new.height) <= 0 or not 0.1 < new.fx / camera.fx < 10 or not 0.1 < new.fy / camera.fy < 10:
        return False
    u, v = np.meshgrid(np.linspace(0, new.width, 9), np.linspace(0, new.height, 9))
    rays = np.stack([(u - new.cx) / new.fx, (v - new.cy) / new.fy, np.ones_like(u)], axis=-1).reshape(-1, 1, 3)
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, _opencv_distortion(camera))
    share = pixels[:, 0] / [camera.width, camera.height]
    return bool((np.abs(share - 0.5) < 0.55).all())


def _opencv_distortion(camera: Camera) -> np.ndarray:
    k1, k2, k3, _, p1, p2 = camera.distortion
    return np.array([k1, k2, p1, p2, k3])
