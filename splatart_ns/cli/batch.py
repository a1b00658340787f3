"""`splatart batch` and `splatart shards`: the commands for many objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from splatart_ns.choices import Format, Quality, Rasterizer, Views
from splatart_ns.cli.common import CONSOLE


@dataclass
class Batch:
    """Fit many captures: each becomes a bundle in the output folder; run it again to do what is missing or changed.

    The exit code is 0 when all objects are done, 3 when some have failed, 4 when all have, 2 for a mistake in what was
    asked. OUTPUT_DIR/report.html and report.csv tell of every object.
    """

    root: Annotated[str, tyro.conf.Positional]
    """A folder above captures, or a manifest: .csv or .jsonl with path, and optionally name, quality, root, seed,
    downscale, joints. Folders may be fsspec URLs (s3://, gs://)."""
    output_dir: str
    """A folder or an fsspec URL."""
    quality: Quality = "standard"
    """As in `splatart fit`."""
    seed: int = 0
    """As in `splatart fit`."""
    downscale: int | None = None
    """As in `splatart fit`."""
    export: Annotated[tuple[tuple[Format, ...], ...], tyro.conf.UseAppendAction] = ()
    """Write these formats, too."""
    rasterizer: Rasterizer = "auto"
    """As in `splatart fit`."""
    address: str | None = None
    """Run on the Ray cluster there (auto, ray://HOST:PORT) instead of this machine's cores."""
    retry_failed: bool = False
    """Try again what has failed before."""

    def run(self) -> None:
        from splatart_ns.batch.command import fit_captures

        settings = {"quality": self.quality, "root": None, "seed": self.seed, "downscale": self.downscale, "joints": []}
        how = (self.rasterizer, sum(self.export, ()), self.address, self.retry_failed)
        raise SystemExit(fit_captures(self.root, self.output_dir, settings, *how, CONSOLE))


@dataclass
class Shards:
    """Render labelled images of many bundles at random views and configurations, as WebDataset tar shards.

    The samples are those of `splatart render --dataset`. Run it again to make what is missing or changed: a shard
    depends on its own bundles alone. A folder that holds more shards than these is refused. Exit codes are those of
    `splatart batch`.
    """

    root: Annotated[str, tyro.conf.Positional]
    """A bundle, or a folder or fsspec URL above bundles, as the output folder of `splatart batch`."""
    output_dir: str
    """A folder or an fsspec URL, for shard-NNNNNN/images.tar."""
    images: int
    """How many, of all bundles together; they take turns."""
    shard_size: int = 1000
    """Images of a shard."""
    states: int = 64
    """Configurations of each bundle."""
    resolution: int = 256
    """Pixels along each side."""
    views: Views = "sphere"
    """See the objects from everywhere, or from above only."""
    seed: int = 0
    """Seed of views and configurations."""
    rasterizer: Rasterizer = "auto"
    """As in `splatart fit`."""
    address: str | None = None
    """As in `splatart batch`."""

    def run(self) -> None:
        from splatart_ns.batch.command import write_shards
        from splatart_ns.batch.shards import ShardOptions

        options = ShardOptions(self.images, self.shard_size, self.states, self.resolution, self.views, self.seed)
        raise SystemExit(write_shards(self.root, self.output_dir, options, self.rasterizer, self.address, CONSOLE))
