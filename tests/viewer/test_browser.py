"""The viewer in a real browser, without a window."""

import json
import socket
import time

import cv2
import numpy as np
import pytest
from viewer_client import free_port

from splatart_ns.bundle import save_bundle

pytest.importorskip("selenium", reason="selenium is not installed: pip install 'splatart-ns[dev]'")
from browser import BROWSER, DRIVER, ActionChains, By, Keys, headless_chromium

VISERS_OWN = (
    "googletagmanager.com",  # asked for by its page; there may be no network
    "Computed radius is NaN",  # by three.js, of a scene without splats
)
SECONDS = 60

pytestmark = pytest.mark.skipif(None in (BROWSER, DRIVER), reason="chromium and chromium-driver are not installed")


@pytest.fixture
def address(bundle, start_splatart, tmp_path):
    """Of the viewer, run by the real command."""
    save_bundle(bundle, tmp_path / "bundle")
    port = free_port()
    process = start_splatart("view", tmp_path / "bundle", "--port", port)
    deadline = time.monotonic() + SECONDS
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            break
        except OSError:
            assert process.poll() is None and time.monotonic() < deadline, process.communicate()[1]
            time.sleep(0.2)
    yield f"http://127.0.0.1:{port}"
    process.terminate()
    process.communicate()


@pytest.fixture
def page(address, tmp_path):
    driver = headless_chromium(tmp_path / "profile", tmp_path / "downloads")
    try:
        driver.get(address)
        yield driver
    finally:
        driver.quit()


def wait_until(condition, what):
    deadline = time.monotonic() + SECONDS
    while not (found := condition()):
        assert time.monotonic() < deadline, f"the browser did not show {what}"
        time.sleep(0.2)
    return found


def sliders(page):
    return page.find_elements(By.CSS_SELECTOR, "[role=slider]")


def shown(page):
    """The picture [H, W, 3] beside the panel."""
    png = page.get_screenshot_as_png()
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[:, :650].astype(int)


def select_part(page, place):
    """Click at a place of the page, x and y in pixels."""
    actions = ActionChains(page)
    actions.w3c_actions.pointer_action.move_to_location(*place).click()
    actions.perform()


def pixels(image, channel):
    """How many pixels have this colour, blue, green or red."""
    return int((image[..., channel] - np.delete(image, channel, axis=2).max(-1) > 100).sum())


def test_a_slider_moves_its_part_and_nothing_goes_wrong(page, tmp_path):
    wait_until(lambda: len(sliders(page)) == 2, "two sliders")
    for label in ("hinge (degree)", "runner (metre)", "base", "lid", "drawer", "-90", "0.4", "Picture (PNG)"):
        wait_until(lambda label=label: label in page.find_element(By.TAG_NAME, "body").text, label)
    wait_until(lambda: min(pixels(shown(page), c) for c in (1, 2)) > 300, "the lid and the base")
    before = shown(page)

    sliders(page)[0].send_keys(Keys.HOME)
    wait_until(lambda: (np.abs(shown(page) - before).max(-1) > 100).sum() > 1000, "the lid's motion")

    at_rest = shown(page)
    rows, columns = np.nonzero(at_rest[..., 1] - np.delete(at_rest, 1, axis=2).max(-1) > 100)  # the lid
    place = int(np.median(columns)), int(np.median(rows))
    select_part(page, place)
    wait_until(lambda: "lid: revolute on base" in page.find_element(By.TAG_NAME, "body").text, "the lid's joint")
    wait_until(lambda: pixels(shown(page), 2) < 100 < pixels(shown(page), 1), "the base faded and the lid not")
    before = shown(page)
    ActionChains(page).move_by_offset(0, 0).click_and_hold().move_by_offset(120, 0).release().perform()
    wait_until(lambda: (np.abs(shown(page) - before).max(-1) > 100).sum() > 1000, "the view turned by a drag")
    assert "lid: revolute on base" in page.find_element(By.TAG_NAME, "body").text
    select_part(page, (15, 500))
    wait_until(lambda: pixels(shown(page), 2) > 300, "the base again, after a click beside the object")

    switch = page.find_element(By.XPATH, "//label[contains(., 'lid')]/following::input[@type='checkbox']")
    page.execute_script("arguments[0].click()", switch)
    wait_until(lambda: pixels(shown(page), 1) < 100, "the object without its lid")

    for name in ("Configuration (JSON)", "Picture (PNG)"):
        button = page.find_element(By.XPATH, f"//button[normalize-space()='{name}']")
        page.execute_script("arguments[0].click()", button)
    configuration, picture = (tmp_path / "downloads" / name for name in ("configuration.json", "picture.png"))
    wait_until(lambda: configuration.exists() and picture.exists(), "the downloads")
    assert json.loads(configuration.read_text())["hinge"] < -np.pi / 2  # beyond what was observed
    assert cv2.imread(str(picture)).shape[0] == 1024

    errors = [entry["message"] for entry in page.get_log("browser") if entry["level"] == "SEVERE"]
    assert [message for message in errors if not any(known in message for known in VISERS_OWN)] == []
