"""The report in a browser: pointer, keys, print, dark mode, a phone; it loads nothing."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import chromium
from PIL import Image
from report_data import Page, pictured_run

import cdmisfa as library
from cdmisfa.experiments.reports import write_report

pytestmark = pytest.mark.system  # a browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a run of pictures, of streams with hostile names."""
    return write_report([pictured_run(tmp_path_factory.mktemp("page") / "run")])


def shown(
    browser: Any, page: Path, width: int = 1200, mode: str = "light", media: str = ""
) -> None:
    """Open a page on a screen of so many pixels across, in light or in dark."""
    feature = {"name": "prefers-color-scheme", "value": mode}
    size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": [feature]})
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(page.as_uri())


def tip(browser: Any, key: str) -> str:
    """What stands where one points; "" where nothing is shown."""
    script = (
        "const t = document.querySelector(`[data-frames=${arguments[0]}] .tip`);"
        "return getComputedStyle(t).display === 'none' ? '' : t.querySelector('span').textContent"
    )
    return str(browser.execute_script(script, key))


def test_pointing_shows_the_frame_that_was_watched(browser: Any, report: Path) -> None:
    shown(browser, report)
    frames, result = Page(report).frames["timeline"], library.Run(report.parent)
    every = result.frames()
    box = browser.execute_script(
        "const a = document.querySelector('[data-frames=timeline] .area');"
        "a.scrollIntoView({block: 'center'}); const r = a.getBoundingClientRect();"
        "return [r.left, r.top, r.width, r.height]"
    )
    for i in (0, len(frames["x"]) // 2, len(frames["x"]) - 1):
        place = {"x": box[0] + frames["x"][i] / 1000 * box[2], "y": box[1] + 5}
        browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseMoved", **place})
        assert tip(browser, "timeline") == frames["text"][i]
        drawn = browser.execute_script(
            "return document.querySelector('[data-frames=timeline] canvas').toDataURL()"
        )
        picture = Image.open(io.BytesIO(base64.b64decode(drawn.partition(",")[2]))).convert("L")
        small = picture.resize((frames["width"], frames["height"]), Image.Resampling.BOX)
        expected = every[frames["t"][i] // 10].astype(float)
        assert np.abs(np.asarray(small, float) - expected).mean() < 6
    browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": 1, "y": 1})
    assert tip(browser, "timeline") == ""


def test_the_same_by_keys(browser: Any, report: Path) -> None:
    from selenium.webdriver import ActionChains, Keys

    shown(browser, report)
    frames = Page(report).frames["timeline"]
    for _ in range(20):
        ActionChains(browser).send_keys(Keys.TAB).perform()
        focused = browser.switch_to.active_element
        if focused.get_attribute("data-frames") == "timeline":
            break
    assert focused.get_attribute("role") == "slider"
    at = 0
    for key, to in (
        (Keys.ARROW_RIGHT, 1),
        (Keys.ARROW_RIGHT, 2),
        (Keys.ARROW_LEFT, 1),
        (Keys.END, len(frames["t"]) - 1),
        (Keys.ARROW_RIGHT, len(frames["t"]) - 1),
        (Keys.HOME, 0),
    ):
        assert tip(browser, "timeline") == frames["text"][at]
        ActionChains(browser).send_keys(key).perform()
        at = to
        assert focused.get_attribute("aria-valuetext") == frames["text"][at]
        assert focused.get_attribute("aria-valuenow") == str(at + 1)
    ActionChains(browser).send_keys(Keys.ESCAPE).perform()
    assert tip(browser, "timeline") == ""


@pytest.mark.parametrize(("width", "mode"), [(1200, "light"), (1200, "dark"), (390, "light")])
def test_everybody_can_read_it(
    browser: Any, report: Path, oscillatory_run: Path, tmp_path: Path, width: int, mode: str
) -> None:
    axe = pytest.importorskip("axe_core_python", reason="pip install axe-core-python")
    rules = (resources.files(axe) / "axe.min.js").read_text("utf-8")
    both = write_report([report.parent, oscillatory_run], tmp_path / "both.html")
    for page in (report, both) if (width, mode) == (1200, "light") else (report,):
        shown(browser, page, width, mode)
        across = "return document.documentElement.scrollWidth"
        assert browser.execute_script(across) <= width
        browser.execute_script(rules)
        result = browser.execute_async_script("axe.run().then(arguments[0])")
        assert [(v["id"], v["nodes"][0]["html"]) for v in result["violations"]] == []
        assert len(result["passes"]) > 10


def test_it_loads_nothing_and_runs_no_other_script(browser: Any, report: Path) -> None:
    browser.get_log("performance")
    browser.get_log("browser")
    shown(browser, report)
    assert [e["message"] for e in browser.get_log("browser")] == []
    asked = set()
    for entry in browser.get_log("performance"):
        event = json.loads(entry["message"])["message"]
        if event["method"] == "Network.requestWillBeSent":
            asked.add(event["params"]["request"]["url"].partition(":")[0])
    assert asked <= {"file", "data"}
    browser.execute_script(
        "const s = document.createElement('script'); s.textContent = 'window.foreign = 1';"
        "document.body.append(s);"
        "const i = new Image(); i.src = 'http://127.0.0.1:9/x.png'; document.body.append(i);"
    )
    assert browser.execute_script("return window.foreign === undefined")
    refused = [e["message"] for e in browser.get_log("browser")]
    assert len([m for m in refused if "Content Security Policy" in m]) == 2
