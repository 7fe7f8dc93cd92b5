"""The site: ordinary words find the right page, and every page is readable on a phone."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from browser import chromium

pytestmark = pytest.mark.system  # a browser

ROOT = Path(__file__).parents[1]

SEARCHES = {
    "start/install": "install, installation, windows, macos, gpu",
    "start/first-run": "quickstart, getting started",
    "start/own-logs": "usb camera, webcam",
    "start/python": "jupyter, notebook, pandas, tensorboard",
    "concepts/how-it-works": "sfa, what is slow feature analysis, curiosity",
    "concepts/glossary": "glossary, stream, novelty",
    "concepts/when-to-use": "limitations, alternatives, pca",
    "how-to/open-data": "rosbag, ros 2, lerobot, mcap, video, csv, filter, trim",
    "how-to/use-modules": "feature extraction, pytorch, policy, anomaly",
    "how-to/many-logs": "duplicate, deduplicate",
    "how-to/find-bad-episodes": "bad episodes, frozen camera",
    "how-to/many-runs": "grid search, hyperparameter, cluster, slurm, dask",
    "how-to/look-at-a-run": "time travel, rewind, thumbnail",
    "how-to/convert-repair-share": "merge, split, repair, corrupt",
    "troubleshooting": "error, troubleshooting, faq",
    "reference/exit-codes": "exit code",
    "evidence/reproducibility": "seed",
    "index": "cite",
}
"""Searches, by the page that they should find first."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site; warnings are errors."""
    for package in ("furo", "myst_parser", "sphinx_copybutton", "sklearn"):
        pytest.importorskip(package, reason="pip install -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    words = ["-q", "-W", "-b", "html", "-d", str(folder / "doctrees"), str(ROOT / "docs")]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words, str(folder / "html")],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder / "html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


# Rates pages as a search does that is typed in; the best result comes last.
FIRST_HITS = """
return arguments[0].map(words => {
    const results = Search._performSearch(...Search._parseQuery(words));
    return results.length ? results.at(-1)[0] : "";
});
"""


def test_ordinary_words_find_the_right_page(browser: Any, site: Path) -> None:
    expected = {words: page for page, some in SEARCHES.items() for words in some.split(", ")}
    from selenium.webdriver.support.wait import WebDriverWait

    browser.get(f"{(site / 'search.html').as_uri()}?q=learn")
    WebDriverWait(browser, 20).until(lambda b: b.execute_script("return Search.hasIndex()"))
    first = dict(zip(expected, browser.execute_script(FIRST_HITS, list(expected)), strict=True))
    assert [words for words, page in first.items() if not page] == []
    wrong = {words: page for words, page in first.items() if page != expected[words]}
    assert wrong == {}


def pages(site: Path) -> list[Path]:
    """Return the pages of the site that are made from a file in docs/."""
    return [p for p in sorted(site.rglob("*.html")) if (ROOT / "docs" / source(p, site)).exists()]


def source(page: Path, site: Path) -> str:
    return str(page.relative_to(site).with_suffix(".md"))


def resize(browser: Any, width: int, mode: str) -> None:
    """Give the browser a screen of so many pixels across, in light or dark mode."""
    feature = {"name": "prefers-color-scheme", "value": mode}
    size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def test_no_page_is_wider_than_a_phone(browser: Any, site: Path) -> None:
    resize(browser, 390, "light")
    wide = {}
    for page in pages(site):
        browser.get(page.as_uri())
        across = browser.execute_script("return document.documentElement.scrollWidth")
        if across > 390:
            wide[source(page, site)] = across
    assert wide == {}


@pytest.mark.parametrize("mode", ["light", "dark"])
@pytest.mark.parametrize("width", [1200, 390])
def test_everybody_can_read_the_pages(browser: Any, site: Path, width: int, mode: str) -> None:
    axe = pytest.importorskip("axe_core_python", reason="pip install axe-core-python")
    rules = (resources.files(axe) / "axe.min.js").read_text("utf-8")
    resize(browser, width, mode)
    for page in ("index.html", "gallery.html", "how-to/open-data.html"):
        browser.get((site / page).as_uri())
        browser.execute_script(rules)
        result = browser.execute_async_script("axe.run({iframes: false}).then(arguments[0])")
        violations = [(v["id"], v["nodes"][0]["html"]) for v in result["violations"]]
        assert violations == [], page
