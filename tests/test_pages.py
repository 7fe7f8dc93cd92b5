"""Pages name files that are there, and show pictures that are small enough and accounted for."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
from sources import DOCUMENTS, ROOT, name

IMAGES = ROOT / "docs" / "images"
MOST_BYTES = 400_000
PAGES = sorted([*DOCUMENTS, *(ROOT / ".github").rglob("*.*")])


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!https?://)([^)#\s]+)", page.read_text("utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize(
    "page",
    # a decision record keeps the paths of its day
    [page for page in PAGES if page.parent.name != "decisions"],
    ids=name,
)
def test_files_that_a_page_names_are_there(page: Path) -> None:
    text = page.read_text("utf-8")
    named = re.findall(
        r"\b(?:cdmisfa|recorder|replay|benchmarks|tests|tools|docs)/[\w/.-]*\w", text
    )
    assert [file for file in named if not (ROOT / file).exists()] == []


def test_every_picture_is_small_accounted_for_and_shown() -> None:
    pages = {page: page.read_text("utf-8") for page in PAGES}
    card = pages.pop(IMAGES / "README.md")
    for picture in IMAGES.glob("*.png"):
        assert picture.stat().st_size < MOST_BYTES
        assert f"`{picture.name}`" in card
        assert any(f"images/{picture.name})" in text for text in pages.values())


@pytest.mark.parametrize("source", [None, "https://forge.example/of/us"])
def test_readme_has_whole_addresses_where_its_files_are_elsewhere(
    source: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("setuptools.setup", lambda **_: None)
    text = runpy.run_path("setup.py")["described"](source)
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert [link for link in links if not link.startswith("https://")] == []
    assert (f"]({source}/raw/v" in text, "![" in text) == (source is not None,) * 2
    assert len(text) > 4000


def test_pictures_are_those_that_the_code_draws() -> None:
    drawn = runpy.run_path(str(IMAGES / "draw.py"))
    names = {path.stem for path in IMAGES.glob("*.png")}
    assert names == {*drawn["VIEWS"], *drawn["REPORTS"], *drawn["EPISODES"], "scene"}
