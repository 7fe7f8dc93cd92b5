"""Draw the pictures of these pages again: runs, views of every tab. `make pictures`.

With names of pictures, only those; runs that are in build/pictures already are not learned again.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from PIL import Image

from cdmisfa.cli import run
from replay.runs.compare import side_by_side
from replay.view.overlay import build_overlay

IMAGES = Path(__file__).parent
SAMPLE = str(IMAGES.parents[1] / "sample_logs" / "icub")
BUILD = IMAGES.parents[1] / "build" / "pictures"

COLOURS = 256
"""Colours of a view's picture, which so takes a third of the bytes; rare ones are kept."""

LEARN = {
    "room": ("icub", "--preset", "icub-real"),
    "icub": (SAMPLE, "--loop"),
    "progress": (SAMPLE, "--loop", "--algorithm", "progress"),
    "progress1": (SAMPLE, "--loop", "--algorithm", "progress", "--seed", "1"),
    "cameras": (
        *(f"{SAMPLE}/{view}.mcap" for view in ("left", "right", "center")),
        *("--topic", "/view/left", "--topic", "/view/right", "--topic", "/view/center", "--loop"),
    ),
    **{f"seed{seed}": ("oscillatory", "--seed", str(seed)) for seed in range(3)},
}
"""Runs, and what `learn` is told to make them."""

COMPARED = {"by 2.0": ("seed0", "seed1", "seed2"), "by progress": ("progress", "progress1")}
"""Runs that are laid over one another."""

VIEWS = {
    "view": ("room", "World", "--at", "4590"),
    "oscillatory": ("seed0", "Overview"),
    "abstraction": ("icub", "Abstraction"),
    "gate": ("icub", "Gate"),
    "decisions": ("seed0", "Decision"),
    "modules": ("progress", "Modules"),
    "values": ("seed0", "World", "--at", "module 2"),
    "wall": ("cameras", "Overview"),
    "progress": ("progress", "Overview"),
    "candidate": ("progress", "Candidate", "--at", "module 2"),
    "recording": (SAMPLE, "World", "--at", "540"),
    "recording-views": (SAMPLE, "Views", "--at", "540"),
    "compare": ("by 2.0", "Overview"),
    "errors": ("by progress", "Streams"),
}
"""Pictures of views: the run or recording, the tab, and further options."""

REPORTS = {"report": ("icub", "1180,1150")}
"""Pictures of reports: the run, and the size of the browser's window."""


def must(*words: str) -> None:
    """Run a command that succeeds."""
    if code := run(list(words)):
        raise SystemExit(f"{' '.join(words)} ended with {code}")


def learned(name: str) -> Path:
    """A run, learned where it is not there yet."""
    folder = BUILD / name
    if not (folder / "run.json").exists():
        must("learn", *LEARN[name], "-o", str(folder), "--no-rerun", "--force")
    return folder


def draw_view(name: str) -> None:
    """Draw one tab of one view."""
    source, tab, *options = VIEWS[name]
    if source in COMPARED:
        shown = BUILD / f"{name}.rrd"
        runs = [learned(compared) for compared in COMPARED[source]]
        build_overlay(runs, side_by_side(runs), shown, force=True, tab=tab)
        tab = ""
    else:
        shown = learned(source) if source in LEARN else Path(source)
    opened = ("--tab", tab) if tab else ()
    drawn = BUILD / f"{name}.png"
    must("view", str(shown), "--screenshot", str(drawn), "--force", *opened, *options)
    fewer_colours(drawn)


def fewer_colours(drawn: Path) -> None:
    """Keep a picture with fewer colours."""
    with Image.open(drawn) as picture:
        few = picture.convert("RGB").quantize(
            COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        few.save(IMAGES / drawn.name, optimize=True)


def draw_report(name: str) -> None:
    """Draw the top of a report, in Chromium."""
    source, size = REPORTS[name]
    page, drawn = BUILD / f"{name}.html", BUILD / f"{name}.png"
    must("report", str(learned(source)), "-o", str(page), "--force")
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no browser: apt-get install chromium")
    flags = ("--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={size}")
    words = [browser, *flags, f"--screenshot={drawn}", page.resolve().as_uri()]
    subprocess.run(words, check=True, capture_output=True)
    fewer_colours(drawn)


def main() -> None:
    """Draw the pictures that are named, by default all."""
    BUILD.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or [*VIEWS, *REPORTS]:
        (draw_report if name in REPORTS else draw_view)(name)


if __name__ == "__main__":
    main()
