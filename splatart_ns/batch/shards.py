"""Labelled images of many bundles as WebDataset shards, each of which can be made again alone."""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import shutil
import tarfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatart_ns.batch.entry import Entry
from splatart_ns.batch.stage import Needs, Stage, Work, stage_key
from splatart_ns.batch.storage import Storage, join, open_storage, require_folder
from splatart_ns.capture.synthesis_options import MOST_PIXELS, MOST_STATES
from splatart_ns.errors import InputError

if TYPE_CHECKING:
    from splatart_ns.bundle.dataset import Dataset, Sample

_BASE_MB = 1500
"""Memory of a process that has loaded the libraries, and of a bundle."""
_BYTES_PER_PIXEL = 100
"""Memory of a pixel of the image that is being made."""
_ARTICULATION = "articulation.json"
_IMAGES = "images.tar"
_SUFFIXES = ("rgb.png", "parts.png", "depth.png", "json")
"""Of a sample's files, as WebDataset's decoders know them, in their order."""


@dataclass(frozen=True)
class ShardOptions:
    """Which images there are. Image i of all is image i // (number of bundles) of bundle i % (number of bundles)."""

    images: int
    """Of all bundles together."""
    shard_size: int = 1000
    """Images of a shard."""
    states: int = 64
    """Configurations of each bundle; its images are dealt out to them."""
    resolution: int = 256
    """Pixels along each side."""
    views: str = "sphere"
    """sphere: from everywhere; hemisphere: from above only."""
    seed: int = 0


def find_bundles(source: str) -> list[str]:
    """Folders of bundles at or below a folder or URL, relative to it, in order.

    Raises:
        InputError: there is none, or no such folder.
    """
    mend = "give the --output-dir of `splatart batch`"
    require_folder(source, mend)
    storage, found, paths = open_storage(source), [], [""]
    while paths:
        path = paths.pop()
        folders, files = storage.children(path)
        if _ARTICULATION in files:
            found.append(path)
            continue
        inner = (name for name in sorted(folders, reverse=True) if not name.startswith("."))
        paths += [join(path, name) for name in inner]
    if not found:
        raise InputError(f"{source}: there is no bundle in it (links to folders are not followed); {mend}.")
    return found


class Shards(Sequence[Entry]):
    """One entry a shard, made when it is asked for: `settings` has its first image, their number, and its bundles."""

    def __init__(self, source: str, bundles: Sequence[str], options: ShardOptions):
        for name in ("images", "shard_size", "states"):
            if (value := getattr(options, name)) < 1:
                raise InputError(f"--{name.replace('_', '-')} is {value}; give 1 or more.")
        if options.states > MOST_STATES:
            raise InputError(f"--states is {options.states}; give {MOST_STATES} or less.")
        if not 8 <= options.resolution <= MOST_PIXELS:
            raise InputError(f"--resolution is {options.resolution}; give 8 to {MOST_PIXELS}.")
        self._url, self._bundles, self._options = open_storage(source).url, bundles, options

    def __len__(self) -> int:
        return math.ceil(self._options.images / self._options.shard_size)

    def __getitem__(self, number: int) -> Entry:
        if not 0 <= number < len(self):
            raise IndexError(number)
        size, total = self._options.shard_size, len(self._bundles)
        first = number * size
        count = min(size, self._options.images - first)
        names = [self._bundles[(first + i) % total] for i in range(min(count, total))]
        return Entry(f"shard-{number:06d}", self._url, {"first": first, "count": count, "of": total, "bundles": names})


def check_no_others(shards: Shards, out: Storage) -> None:
    """Raise InputError where the output holds a shard that is none of these: who trains on all would read it too."""
    for name in sorted(out.children("")[0]):
        number = re.fullmatch(r"shard-(\d{6,})", name)
        if number and int(number[1]) >= len(shards) and _IMAGES in out.children(name)[1]:
            found = f"holds {name}, of a run with more shards than these {len(shards)}"
            raise InputError(f"{out.url}: {found}; remove it, or give another --output-dir.")


@dataclass(frozen=True)
class Sharding:
    """Shards as `SHARD/images.tar`."""

    options: ShardOptions
    rasterizer: str = "auto"

    def fingerprint(self, entry: Entry) -> str:
        source = open_storage(entry.capture)
        return stage_key([(name, _stamps(source, name)) for name in entry.settings["bundles"]])

    def stages(self, entry: Entry, fingerprint: str, told: dict[str, Any] | None) -> list[Stage]:
        package = version("splatart-ns")
        read = Stage("read", stage_key("read", package, fingerprint), needs=Needs(memory_mb=_BASE_MB))
        if told is None:
            return [read]
        options = {key: value for key, value in asdict(self.options).items() if key not in ("images", "shard_size")}
        key = stage_key("images", package, told["digest"], entry.settings, options, self.rasterizer)
        memory = _BASE_MB + self.options.resolution**2 * _BYTES_PER_PIXEL // 2**20
        return [read, Stage("images", key, ("read",), Needs(memory_mb=memory, gpu=True))]

    def run(self, stage: str, work: Work) -> tuple[dict[str, Any], Sequence[str]]:
        if stage == "read":
            return {"digest": _digest(work)}, ()
        import torch

        from splatart_ns.rasterize.rasterization import set_backend

        torch.set_num_threads(1)
        set_backend(self.rasterizer)
        pictures = self._write(work, work.folder / _IMAGES)
        return {"images": work.entry.settings["count"], "thumbnails": pictures}, [_IMAGES]

    def outcome_shape(self, stage: str) -> Any:
        return {"digest": str} if stage == "read" else {"images": int, "thumbnails": [str]}

    def row(self, entry: Entry, outcomes: dict[str, dict[str, Any]]) -> dict[str, Any]:
        empty = {"parts": [], "joints": [], "failed_checks": []}
        return empty | {"thumbnails": outcomes["images"]["thumbnails"]}

    def _write(self, work: Work, path: Path) -> list[str]:
        """The shard, and its first pictures for the report."""
        first, count, total = (work.entry.settings[key] for key in ("first", "count", "of"))
        # Made bundle by bundle, kept image by image: they wait in files, for all of a shard may not fit in memory.
        waiting = work.folder.parent / "samples"
        waiting.mkdir(exist_ok=True)
        for place, name in enumerate(work.entry.settings["bundles"]):
            dataset, title = self._dataset(work, name), name or work.entry.capture.rsplit("/", 1)[-1]
            for image in range(first + place, first + count, total):
                for suffix, data in _encode(dataset, dataset[image // total], title).items():
                    (waiting / f"{image:09d}.{suffix}").write_bytes(data)
        pictures = [_thumbnail(waiting / f"{image:09d}.rgb.png") for image in range(first, first + min(count, 2))]
        with tarfile.open(path, "w") as tar:
            for image in range(first, first + count):
                for suffix in _SUFFIXES:
                    file = waiting / f"{image:09d}.{suffix}"
                    about = tarfile.TarInfo(file.name)  # no time and no owner: the same bytes each time
                    about.size = file.stat().st_size
                    with open(file, "rb") as data:
                        tar.addfile(about, data)
                    file.unlink()
        return pictures

    def _dataset(self, work: Work, name: str) -> Dataset:
        from splatart_ns.bundle import load
        from splatart_ns.bundle.dataset import Dataset, DatasetOptions

        source, folder = open_storage(work.entry.capture), work.folder.parent / "bundle-read"
        shutil.rmtree(folder, ignore_errors=True)  # of the bundle before
        (folder / "parts").mkdir(parents=True)
        source.get(join(name, "parts"), folder / "parts")
        (folder / _ARTICULATION).write_bytes(source.read(join(name, _ARTICULATION)) or b"")
        # Bundles of one seed would be seen from the same places.
        own = hashlib.sha256(json.dumps([self.options.seed, name]).encode()).digest()
        options = DatasetOptions(
            self.options.states, self.options.resolution, self.options.views, int.from_bytes(own[:6], "big")
        )
        return Dataset(load(folder), options)


def _stamps(source: Storage, name: str) -> list[tuple[str, int, str]]:
    files = source.files(join(name, "parts"))
    parts = sorted((file, info.size, info.stamp) for file, info in files.items())
    articulation = source.read(join(name, _ARTICULATION)) or b""
    return [*parts, (_ARTICULATION, len(articulation), hashlib.sha256(articulation).hexdigest())]


def _digest(work: Work) -> str:
    """Of all that is rendered of the shard's bundles."""
    source, digest = open_storage(work.entry.capture), hashlib.sha256()
    for name in work.entry.settings["bundles"]:
        parts = join(name, "parts")
        for path in (join(name, _ARTICULATION), *(f"{parts}/{file}" for file in sorted(source.files(parts)))):
            digest.update(path.encode() + b"\0" + (source.read(path) or b""))
    return digest.hexdigest()


def _encode(dataset: Dataset, sample: Sample, name: str) -> dict[str, bytes]:
    """A sample's files by their suffixes."""
    import cv2
    import numpy as np

    def png(image: np.ndarray) -> bytes:
        return cv2.imencode(".png", image)[1].tobytes()

    unit = max(float(sample.depth.max()), 1e-9) / 65535
    bundle = dataset.splat.bundle
    about = {
        "object": name,
        "state": sample.state,
        "q": sample.q,
        "T_world_camera": sample.camera.T_world_camera.tolist(),
        "K": sample.camera.K.tolist(),
        "depth_unit": unit,
        "length_unit": bundle.length_unit,
        "parts": {part.id: part.name for part in bundle.parts},
    }
    return {
        "rgb.png": png(cv2.cvtColor(sample.rgba, cv2.COLOR_RGBA2BGRA)),
        "parts.png": png(sample.labels),
        "depth.png": png((sample.depth / unit).round().astype(np.uint16)),
        "json": json.dumps(about).encode(),
    }


def _thumbnail(png: Path) -> str:
    import base64

    from PIL import Image

    image = Image.open(png)
    white = Image.new("RGBA", image.size, "white")
    data = io.BytesIO()
    Image.alpha_composite(white, image).convert("RGB").resize((96, 96)).save(data, "JPEG", quality=80)
    return base64.b64encode(data.getvalue()).decode()
