"""The page of `--format html` in a real browser, from the file system."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from splatart_ns.bundle import configured_motions
from splatart_ns.bundle.export.page import write_page
from splatart_ns.bundle.sliders import bundle_sliders, configuration

pytest.importorskip("selenium", reason="selenium is not installed: pip install 'splatart-ns[dev]'")
from browser import BROWSER, DRIVER, By, Keys, headless_chromium
from exported_page import ExportedPage, psnr, rasterized

KINDS = ("revolute", "prismatic", "screw", "cylindrical", "spherical", "free", "fixed")
EVIL = '</script><img src=x onerror="window.hacked = 1">'
SECONDS = 60

pytestmark = pytest.mark.skipif(None in (BROWSER, DRIVER), reason="chromium and chromium-driver are not installed")


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    driver = headless_chromium(folder / "profile", folder)
    yield driver
    driver.quit()


@pytest.fixture
def show(driver, tmp_path):
    def show(bundle):
        driver.get_log("browser")  # of earlier pages
        return ExportedPage(driver, write_page(bundle, "thing", tmp_path))

    return show


def random_q(bundle, seed):
    rng, sliders = np.random.default_rng(seed), bundle_sliders(bundle)
    return configuration(sliders, [rng.uniform(slider.low, slider.high) for slider in sliders])


def wait_until(condition, what):
    deadline = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < deadline, f"the page did not show {what}"
        time.sleep(0.05)


def test_every_type_of_joint_moves_as_in_the_bundle(objects, show):
    bundle = objects.chain(list(KINDS))
    page = show(bundle)
    for q in [{}, *(random_q(bundle, seed) for seed in range(20))]:
        wanted = np.stack([T.numpy() for T in configured_motions(bundle, q).values()])
        np.testing.assert_allclose(page.motions(q), wanted, atol=1e-9)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_pictures_are_those_of_our_rasterizer(degree, objects, show):
    bundle = objects.chain(["revolute", "spherical"])
    g = torch.Generator().manual_seed(degree)
    for i, part in enumerate(bundle.parts):
        splat, n = part.splat, 60
        means = splat.means.mean(0) + 0.1 * torch.randn(n, 3, generator=g)
        sh = 0.3 * torch.randn(n, (degree + 1) ** 2 if i else 1, 3, generator=g)
        log_scales, opacity_logits = torch.randn(n, 3, generator=g) - 4.5, 2 + 2 * torch.randn(n, generator=g)
        quats = torch.randn(n, 4, generator=g)
        bundle.parts[i] = replace(part, splat=replace(splat, means=means, quats=quats, log_scales=log_scales,
                                                      opacity_logits=opacity_logits, sh=sh))  # fmt: skip
    page = show(bundle)
    camera = page.camera(200, 160)
    pictures = []
    for q in ({}, random_q(bundle, 1)):
        picture, _ = page.draw(q, camera)
        assert psnr(picture[..., :3], rasterized(bundle, q, camera)) > 55
        pictures.append(picture.astype(int))
    assert np.abs(pictures[1] - pictures[0]).mean() > 2


def test_what_a_person_does_is_shown_and_nothing_goes_wrong(objects, show):
    bundle = objects.chain(["revolute", "cylindrical"], length_unit="metre")
    bundle.parts[1].name = bundle.joints[0].child = bundle.joints[1].parent = EVIL
    bundle.joints[0].name, bundle.joints[0].ambiguous = EVIL, True
    page = show(bundle)
    driver = page.driver

    def value():
        return driver.execute_script("return splatart.page.values")

    def shown():
        driver.execute_script("document.activeElement.blur()")
        png = driver.find_element(By.ID, "picture").screenshot_as_png
        return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(int)

    def wait_for_change(since, what):
        wait_until(lambda: (np.abs(shown() - since).max(-1) > 60).sum() > 200, what)

    ranges = driver.find_elements(By.CSS_SELECTOR, "input[type=range]")
    labels = [r.get_attribute("aria-label") for r in ranges]
    assert labels == [f"{EVIL} (degree)", "j2 slide (metre)", "j2 turn (degree)"]
    texts = driver.execute_script("return document.getElementById('joints').textContent")
    assert EVIL in texts and "cylindrical" in texts and "yes" in texts and "slide −0.1 to 0.2 metre" in texts

    wait_until(lambda: driver.execute_script("return splatart.page.isWarm"), "the first picture")
    before = shown()
    ranges[0].send_keys(Keys.HOME)
    assert value()[0][0] < -0.5
    wait_for_change(before, "the joint's motion")
    driver.find_element(By.ID, "reset").click()
    assert value() == [[0.0], [0.0, 0.0]]

    number = driver.find_elements(By.CSS_SELECTOR, "input[type=number]")[1]
    number.clear()
    number.send_keys("0.15")
    assert value()[1] == [0.15, 0.0]

    still = shown()
    for selector in ("#part-colours", "#parts input"):
        driver.find_element(By.CSS_SELECTOR, selector).click()
        wait_for_change(still, selector)
        still = shown()

    driver.find_element(By.ID, "play").click()
    wait_until(lambda: value()[0][0] > 0.1, "the sweep")
    driver.find_element(By.ID, "reset").click()
    assert not driver.find_element(By.ID, "play").is_selected() and value()[0] == [0.0]

    assert driver.find_elements(By.TAG_NAME, "img") == [] and driver.execute_script("return window.hacked") is None
    assert not driver.find_element(By.ID, "complaint").is_displayed()
    assert page.errors() == []


def test_mouse_and_fingers_move_the_camera(objects, show):
    page = show(objects.chain(["revolute"]))
    driver = page.driver
    names = ("azimuth", "elevation", "distance", "target")
    camera = f"const camera = splatart.page.camera; return [{', '.join(f'camera.{name}' for name in names)}]"

    def touch(kind, *points):
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def mouse(kind, x, y, **more):
        driver.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y, **more})

    def drag(button, buttons):
        mouse("mousePressed", 200, 200, button=button, buttons=buttons, clickCount=1)
        mouse("mouseMoved", 260, 180, button=button, buttons=buttons)
        mouse("mouseReleased", 260, 180, button=button, buttons=0, clickCount=1)

    def moved(act):
        before = driver.execute_script(camera)
        act()
        wait_until(lambda: driver.execute_script(camera) != before, "another view")
        after = driver.execute_script(camera)
        return {name for name, a, b in zip(names, before, after, strict=True) if a != b}

    assert moved(lambda: drag("left", 1)) == {"azimuth", "elevation"}
    assert moved(lambda: drag("right", 2)) == {"target"}
    assert moved(lambda: mouse("mouseWheel", 200, 200, deltaX=0, deltaY=100)) == {"distance"}

    def one_finger():
        touch("touchStart", (200, 200))
        touch("touchMove", (260, 180))
        touch("touchEnd")

    def two_fingers():
        touch("touchStart", (200, 200), (300, 200))
        touch("touchMove", (150, 200), (350, 200))  # the middle stays
        touch("touchEnd")

    assert moved(one_finger) == {"azimuth", "elevation"}
    assert "distance" in moved(two_fingers)
    assert page.errors() == []
