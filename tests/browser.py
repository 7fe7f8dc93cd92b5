"""Chromium without a screen, and what it draws of a view."""

from __future__ import annotations

import contextlib
import io
import shutil
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
SECONDS = 240
"""Longest wait for a page that is drawn without a graphics card on a busy machine."""

LANES = {"stream watched": (124, 195, 238), "novel": (193, 181, 216)}
"""Colours of lanes of the overview, as the browser shows them."""

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--force-device-scale-factor=1",
    "--window-size=1200,800",
)


@contextlib.contextmanager
def chromium(folder: Path) -> Iterator[Any]:
    """Chromium without a screen, which can reach this machine only; its profile is in a folder."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="pip install selenium")
    if BROWSER is None or DRIVER is None:
        pytest.skip("no browser: apt-get install chromium chromium-driver")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in FLAGS:
        options.add_argument(flag)
    options.add_argument(f"--user-data-dir={folder / 'profile'}")
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1")
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "WARNING"})
    with webdriver.Chrome(options=options, service=Service(DRIVER)) as driver:
        yield driver


def picture(driver: Any) -> Any:
    """The page's pixels (height, width, 3); none where the browser is too busy to say."""
    from selenium.common.exceptions import WebDriverException

    try:
        png = driver.get_screenshot_as_png()
    except WebDriverException as error:
        print(f"{time.monotonic():.0f} s: {str(error).splitlines()[0]}")
        return np.empty((0, 0, 3), dtype=int)
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    print(f"{time.monotonic():.0f} s: {shown(pixels)} in a picture of {len(png)} bytes")
    return pixels


def shown(pixels: Any) -> dict[str, int]:
    """How many pixels have each lane's colour."""
    return {
        name: int((np.abs(pixels - colour).max(axis=2) <= 12).sum())
        for name, colour in LANES.items()
    }


def drawn(driver: Any, lanes: Collection[str] = tuple(LANES)) -> None:
    """Wait until lanes of a run are drawn."""
    end = time.monotonic() + SECONDS
    while min(shown(picture(driver))[lane] for lane in lanes) <= 1000:
        assert time.monotonic() < end, "the page does not show the run"
        time.sleep(3)


def errors(driver: Any) -> list[str]:
    """What the browser calls errors, but for what the policy refuses."""
    result = [e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"]
    expected = ("Content Security Policy", "TypeError: Failed to fetch")
    return [error for error in result if not any(word in error for word in expected)]
