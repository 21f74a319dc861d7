"""A browser without a screen, for tests that look at pages."""

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

FLAGS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars --force-device-scale-factor=1 "
    "--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
)
"""The last three draw WebGL without a graphics card."""


@contextmanager
def chromium(profile: Path, *, size: tuple[int, int] = (1200, 1400)) -> Iterator[Any]:
    """A driver of Debian's Chromium; the tests are skipped where that is not installed.

    Args:
        profile: a folder of its own.
        size: (width, height) of the window.
    """
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("no chromium and chromedriver: apt-get install chromium chromium-driver")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    for flag in (*FLAGS.split(), "--window-size={},{}".format(*size), f"--user-data-dir={profile}"):
        options.add_argument(flag)
    opened = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        opened.set_script_timeout(20)
        yield opened
    finally:
        opened.quit()


def settled(browser: Any) -> None:
    """Wait until what was asked for is drawn."""
    browser.execute_async_script(
        "const done = arguments[0];"
        "Promise.all([...document.images].map((image) => image.decode().catch(() => 0)))"
        ".then(() => requestAnimationFrame(() => requestAnimationFrame(() => done())))"
    )


def picture_of(browser: Any, selector: str) -> np.ndarray:
    """``(H, W, 3)`` what an element looks like, 0..255 as float."""
    settled(browser)
    png = browser.find_element("css selector", selector).screenshot_as_png
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB")).astype(float)


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """The share of pixels that look otherwise."""
    return float((np.abs(before - after).max(axis=-1) > 24).mean())
