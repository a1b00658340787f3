"""How long the viewer takes from a key on a slider to the picture, in Chromium without a GPU.

Usage:
    python benchmarks/viewer.py OUT [--moves 20]

It needs chromium and chromium-driver, and selenium (extra dev). Times are on the page's clock, from the key's event to
the first frame whose pixels differ, and to the last one, which is the image at rest.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "plugin"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "viewer"))
from browser import By, Keys, headless_chromium
from viewer_client import free_port

from splatart_ns.bundle import load
from splatart_ns.viewer.viewer import Viewer

START_SECONDS, MOVE_SECONDS = 15, 2
WATCH = """
    const canvas = document.querySelector("canvas[data-engine]"), small = document.createElement("canvas");
    const width = small.width = 160, height = small.height = 100;
    const context = small.getContext("2d", {willReadFrequently: true});
    let before = null;
    window.changes = [];
    function watch() {
        context.drawImage(canvas, 0, 0, width, height);
        const now = context.getImageData(0, 0, width, height).data;
        if (before && now.some((value, i) => Math.abs(value - before[i]) > 8)) window.changes.push(performance.now());
        before = now;
        requestAnimationFrame(watch);
    }
    watch();
    document.addEventListener("keydown", () => { window.pressed = performance.now(); window.changes = []; }, true);
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--moves", type=int, default=20)
    arguments = parser.parse_args()
    port = free_port()
    viewer = Viewer(load(arguments.bundle), "127.0.0.1", port)
    threading.Thread(target=viewer.run, daemon=True).start()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        page = headless_chromium(Path(folder) / "profile", Path(folder) / "downloads")
        try:
            page.get(f"http://127.0.0.1:{port}")
            time.sleep(START_SECONDS)
            page.execute_script(WATCH)
            sliders = page.find_elements(By.CSS_SELECTOR, "[role=slider]")
            times = []
            for move in range(arguments.moves):
                key = Keys.END if move // len(sliders) % 2 == 0 else Keys.HOME
                sliders[move % len(sliders)].send_keys(key)
                time.sleep(MOVE_SECONDS)
                times.append(page.execute_script("return window.changes.map(time => time - window.pressed)"))
        finally:
            page.quit()
    seen = [changes for changes in times if changes]
    for name, place in ("first picture", 0), ("picture at rest", -1):
        found = [changes[place] for changes in seen]
        print(f"{name}: median {statistics.median(found):.0f} ms, worst {max(found):.0f} ms, {len(found)} moves")
    viewer.stop()


if __name__ == "__main__":
    main()
