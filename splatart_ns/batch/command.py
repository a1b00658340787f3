"""`splatart batch` and `splatart shards`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console

from splatart_ns.batch.batch import run_batch
from splatart_ns.batch.cluster import RayCluster
from splatart_ns.batch.entry import Entry, check_apart, read_entries
from splatart_ns.batch.fitting import Fitting
from splatart_ns.batch.pool import ProcessPool
from splatart_ns.batch.progress import LiveProgress
from splatart_ns.batch.shards import Sharding, ShardOptions, Shards, check_no_others, find_bundles
from splatart_ns.batch.stage import Recipe
from splatart_ns.batch.storage import open_storage
from splatart_ns.choices import require_downscale, require_seed

ALL_DONE, SOME_FAILED, ALL_FAILED = 0, 3, 4
"""Exit codes."""


def fit_captures(
    source: str,
    out_url: str,
    settings: dict[str, Any],
    rasterizer: str,
    exports: tuple[str, ...],
    address: str | None,
    retry_failed: bool,
    console: Console,
) -> int:
    """Fit all captures of a source, see `read_entries`; returns the exit code."""
    from splatart_ns.bundle.export.formats import require

    require_seed(settings["seed"])
    require_downscale(settings["downscale"])
    if address is None:  # other machines may have other libraries
        require(exports)
    recipe = Fitting(rasterizer, tuple(dict.fromkeys(exports)))
    entries = read_entries(source, settings)
    check_apart(entries, open_storage(out_url))
    return _run(entries, out_url, recipe, address, retry_failed, console, "objects")


def write_shards(
    source: str, out_url: str, options: ShardOptions, rasterizer: str, address: str | None, console: Console
) -> int:
    """Render labelled images of all bundles below a source; returns the exit code."""
    entries = Shards(source, find_bundles(source), options)
    check_no_others(entries, open_storage(out_url))
    return _run(entries, out_url, Sharding(options, rasterizer), address, True, console, "shards")


def _run(
    entries: Sequence[Entry],
    out_url: str,
    recipe: Recipe,
    address: str | None,
    retry_failed: bool,
    console: Console,
    things: str,
) -> int:
    out = open_storage(out_url)
    engine = ProcessPool() if address is None else RayCluster(address)
    with LiveProgress(entries, out, console) as progress:
        run_batch(entries, out.url, recipe, engine, progress, retry_failed)
    counts = progress.report.counts
    failed = f", {counts['failed']} failed" if counts["failed"] else ""
    console.print(f"{counts['done']} of {len(entries)} {things} done{failed}: {out.url}/report.html", soft_wrap=True)
    if counts["failed"] == 0:
        return ALL_DONE
    return SOME_FAILED if counts["done"] else ALL_FAILED
