"""How exact, large and fast the page of `splatart export --format html` is, in Chromium without a GPU.

Usage:
    python benchmarks/page.py OUT [OUT ...]

It needs chromium and chromium-driver, and selenium (extra dev). Pictures are compared with those of our own rasterizer
on black at 512 x 512 pixels, from the page's first view and from two others, with the joints at 0 and at random values.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "viewer"))
from browser import headless_chromium
from exported_page import ExportedPage, psnr, rasterized

from splatart_ns.bundle import configured_motions, load_bundle
from splatart_ns.bundle.configurations import Configuration
from splatart_ns.bundle.export.page import write_page
from splatart_ns.bundle.sliders import bundle_sliders, configuration

SIDE = 512
TURNS = (0.0, 2.1, 4.2)  # radian, of the views
FRAMES = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", type=Path, nargs="+")
    for folder in parser.parse_args().bundles:
        measure(folder)


def measure(folder: Path) -> None:
    bundle = load_bundle(folder)
    sliders, rng = bundle_sliders(bundle), np.random.default_rng(0)

    def random_q() -> Configuration:
        return configuration(sliders, [rng.uniform(slider.low, slider.high) for slider in sliders])

    count = sum(len(part.splat) for part in bundle.parts)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        path = write_page(bundle, folder.name, Path(scratch))
        print(f"{folder.name}: {path.stat().st_size / 1000:.0f} kB, {count} Gaussians")
        driver = headless_chromium(Path(scratch) / "profile", Path(scratch))
        try:
            page = ExportedPage(driver, path)
            for name, q in {"rest": {}, "moved": random_q()}.items():
                print(f"  {name}: {', '.join(f'{x:.1f}' for x in _psnrs(page, bundle, q))} dB")
            errors = []
            for _ in range(100):
                q = random_q()
                wanted = np.stack([T.numpy() for T in configured_motions(bundle, q).values()])
                errors.append(np.abs(page.motions(q) - wanted).max())
            print(f"  motions: off by {max(errors):.0e} at most of 100")
            for size in ((680, 560), (1600, 1000)):
                camera = page.camera(*size)
                seconds = [page.draw(random_q(), camera)[1] for _ in range(FRAMES)]
                print(f"  {size[0]} x {size[1]}: {1000 * statistics.median(seconds):.0f} ms a frame, in the median")
        finally:
            driver.quit()


def _psnrs(page: ExportedPage, bundle, q: Configuration) -> list[float]:
    found = []
    for turn in TURNS:
        page.driver.execute_script("splatart.page.camera.azimuth += arguments[0]", turn)
        camera = page.camera(SIDE, SIDE)
        page.driver.execute_script("splatart.page.camera.reset()")
        found.append(psnr(page.draw(q, camera)[0][..., :3], rasterized(bundle, q, camera)))
    return found


if __name__ == "__main__":
    main()
