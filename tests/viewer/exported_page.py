"""A page that `splatart export --format html` wrote, open in a browser."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from selenium.webdriver import Chrome

from splatart_ns.bundle import Bundle, posed_splat
from splatart_ns.bundle.posing import JointValue
from splatart_ns.rasterize.render import render

DRAW = """
    const [values, camera, done] = arguments, page = splatart.page;
    const before = page.values;
    page.values = values;
    const started = performance.now();
    page.draw(camera ?? page.camera.at(page.canvas.width, page.canvas.height)).then(() => {
        const bytes = page.renderer.pixels(), seconds = (performance.now() - started) / 1000;  // reading waits for it
        page.values = before;
        let text = "";
        for (let i = 0; i < bytes.length; i += 4096) text += String.fromCharCode(...bytes.subarray(i, i + 4096));
        done([btoa(text), page.canvas.width, page.canvas.height, seconds]);
    });
"""


class ExportedPage:
    """Asks the page's own functions; `q` is a configuration of the bundle."""

    def __init__(self, driver: Chrome, path: Path):
        self.driver = driver
        driver.set_script_timeout(60)
        driver.get(path.resolve().as_uri())
        self.joints = driver.execute_script("return splatart.object.joints.map(joint => joint.name)")
        self.freedoms = driver.execute_script("return splatart.object.joints.map(joint => joint.values[0].length)")

    def values(self, q: Mapping[str, JointValue]) -> list[list[float]]:
        """As the page has them: an array for each joint."""
        pairs = zip(self.joints, self.freedoms, strict=True)
        return [np.ravel(q[name]).tolist() if name in q else [0.0] * count for name, count in pairs]

    def motions(self, q: Mapping[str, JointValue]) -> np.ndarray:
        """T[part] [P, 4, 4] that the page computes."""
        return np.array(
            self.driver.execute_script("return partMotions(splatart.object, arguments[0])", self.values(q))
        ).reshape(-1, 4, 4)

    def camera(self, width: int, height: int) -> dict:
        """The page's camera on so many pixels."""
        return self.driver.execute_script("return splatart.page.camera.at(...arguments)", width, height)

    def draw(self, q: Mapping[str, JointValue], camera: dict | None = None) -> tuple[np.ndarray, float]:
        """The picture [H, W, 4] over black, 0..255, and the seconds it took; by default as large as the page's own."""
        text, width, height, seconds = self.driver.execute_async_script(DRAW, self.values(q), camera)
        pixels = np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)
        return pixels[::-1], seconds

    def errors(self) -> Sequence[str]:
        """What the console says."""
        return [entry["message"] for entry in self.driver.get_log("browser")]


def rasterized(bundle: Bundle, q: Mapping[str, JointValue], camera: dict) -> np.ndarray:
    """What our own rasterizer draws there [H, W, 3] over black, 0..255."""
    viewmat = torch.tensor(camera["T_camera_world"]).reshape(1, 4, 4)
    K = torch.tensor([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]])[None]
    rgb = render(posed_splat(bundle, q), viewmat, K, camera["width"], camera["height"], with_depth=False).rgb
    return 255 * rgb[0].clamp(0, 1).numpy()


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.square(image.astype(float) - reference).mean()))
