"""Chromium without a window, driven by selenium."""

from __future__ import annotations

import shutil
from pathlib import Path

from selenium.webdriver import ActionChains as ActionChains
from selenium.webdriver import Chrome, ChromeOptions, ChromeService
from selenium.webdriver.common.by import By as By
from selenium.webdriver.common.keys import Keys as Keys

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
_FLAGS = (
    *("--headless", "--no-sandbox", "--window-size=1000,700", "--no-first-run", "--disable-quic", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a GPU
)


def headless_chromium(profile: Path, downloads: Path) -> Chrome:
    """A browser with a new profile in the folder `profile`, which saves what it downloads to `downloads`."""
    options = ChromeOptions()
    options.binary_location = BROWSER
    for flag in (*_FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    # A page that downloads several files is asked about else, and nobody is there to answer.
    preferences = {"profile.default_content_setting_values.automatic_downloads": 1}
    options.add_experimental_option("prefs", preferences | {"download.default_directory": str(downloads)})
    return Chrome(options=options, service=ChromeService(DRIVER))
