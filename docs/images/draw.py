"""Draw the images of these pages again: every tab of views, and tops of reports. `make images`.

With names of images, only those. Complete runs in build/images and build/gallery are used again.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1]))

import demonstrations

from cdmisfa.cli import run
from replay import viewer
from replay.runs.compare import side_by_side
from replay.view.comparison import build_overlay

DOCS = Path(__file__).parents[1]
IMAGES = DOCS / "images"
SAMPLE = str(DOCS.parent / "sample_logs" / "icub")
BUILD = DOCS.parent / "build" / "images"
GALLERY = DOCS.parent / "build" / "gallery"

# Colors of an image, which so takes a third of the bytes; rare colors are kept.
COLORS = 256

# Size of the viewer's window in points. Text stays readable where a page shows the image 700
# pixels wide.
WINDOW = "1150x800"
SMALL_WINDOW = "900x700"

# Points at the top of the window: the viewer's menu, with warnings about this machine.
MENU = 36

# Runs, and the arguments of `learn` that make them.
LEARN = {
    "room": ("icub", "--preset", "icub-real", "--set", "learner.watch=120"),
    "icub": (SAMPLE, "--loop"),
    "progress": (SAMPLE, "--loop", "--algorithm", "progress"),
    "progress1": (SAMPLE, "--loop", "--algorithm", "progress", "--seed", "1"),
    "cameras": (
        *(f"{SAMPLE}/{view}.mcap" for view in ("left", "right", "center")),
        *("--topic", "/view/left", "--topic", "/view/right", "--topic", "/view/center", "--loop"),
    ),
    **{f"seed{seed}": ("oscillatory", "--seed", str(seed)) for seed in range(3)},
}

# Runs that are laid over one another.
COMPARED = {"by 2.0": ("seed0", "seed1", "seed2"), "by progress": ("progress", "progress1")}

# Images of views: the run or recording, the tab, and further options.
VIEWS = {
    "view": ("room", "World", "--at", "14680"),
    "oscillatory": ("seed0", "Overview"),
    "abstraction": ("icub", "Candidate"),
    "gate": ("icub", "Novelty"),
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

# Views in a small window.
SMALL = ("view", "recording")

# Images of reports: the run, in the gallery with its folder, and the size of the browser's window.
REPORTS = {
    "report": ("icub", "1000,1100"),
    "gallery-icub": ("runs/icub", "900,720"),
    "gallery-photographs": ("runs/photographs", "900,790"),
    "gallery-rejected": ("runs/rejected", "900,790"),
}

# Images of pages of bad episodes, and the size of the browser's window.
EPISODES = {"episodes": "900,1080"}


def must(*words: str) -> None:
    """Run a command that succeeds."""
    if code := run(list(words)):
        raise SystemExit(f"{' '.join(words)} ended with {code}")


def learned(name: str) -> Path:
    """Return the folder of a run, which is learned if it is missing."""
    if name.startswith("runs/"):
        runs = [GALLERY / source for source, _ in REPORTS.values() if source.startswith("runs/")]
        if not all((folder / "run.json").exists() for folder in runs):
            shutil.rmtree(GALLERY, ignore_errors=True)
            GALLERY.mkdir(parents=True)
            demonstrations.make_runs(GALLERY)
        return GALLERY / name
    folder = BUILD / name
    if not (folder / "run.json").exists():
        must("learn", *LEARN[name], "-o", str(folder), "--no-rerun", "--force")
    return folder


def draw_view(name: str) -> None:
    """Draw one tab of one view."""
    source, tab, *options = VIEWS[name]
    if source in COMPARED:
        path = BUILD / f"{name}.rrd"
        runs = [learned(compared) for compared in COMPARED[source]]
        build_overlay(runs, side_by_side(runs), path, force=True, tab=tab)
        tab = ""
    else:
        path = learned(source) if source in LEARN else Path(source)
    tab_options = ("--tab", tab) if tab else ()
    drawn = BUILD / f"{name}.png"
    viewer.WINDOW = SMALL_WINDOW if name in SMALL else WINDOW
    must("view", str(path), "--screenshot", str(drawn), "--force", *tab_options, *options)
    save(drawn, top=MENU)


def save(drawn: Path, top: int = 0, method: int = Image.Quantize.MAXCOVERAGE) -> None:
    """Save an image for the pages: without its top, and with fewer colors."""
    with Image.open(drawn) as image:
        part = image.convert("RGB").crop((0, top, *image.size))
        part.quantize(COLORS, method=method, dither=Image.Dither.NONE).save(
            IMAGES / drawn.name, optimize=True
        )


def draw_report(name: str) -> None:
    """Draw the top of a report, in Chromium."""
    source, size = REPORTS[name]
    page, drawn = BUILD / f"{name}.html", BUILD / f"{name}.png"
    must("report", str(learned(source)), "-o", str(page), "--force")
    screenshot(page, drawn, size)


def screenshot(
    page: Path, drawn: Path, size: str, method: int = Image.Quantize.MAXCOVERAGE
) -> None:
    """Draw the top of a page in Chromium."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no browser: apt-get install chromium")
    flags = ("--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={size}")
    words = [browser, *flags, f"--screenshot={drawn}", page.resolve().as_uri()]
    subprocess.run(words, check=True, capture_output=True)
    save(drawn, method=method)


def draw_episodes(name: str) -> None:
    """Draw the top of the page of bad episodes, of simulated ones with planted faults."""
    from benchmarks.robot_episodes import CAMERAS, dataset, make_pool

    pool, data, out = BUILD / "pool", BUILD / "stack", BUILD / "check"
    if not data.exists():
        make_pool(pool / "stack", "stack", 7001, 12, 1)
        rows = json.loads((pool / "stack/pool.json").read_text())
        good = [row for row in rows if not row["fault"]]
        bad = [row for row in rows if row["fault"] in ("black", "frozen", "lag", "object")]
        dataset(data, [{**row, "pool": str(pool)} for row in (*good, *bad)], CAMERAS)
    must("episodes", str(data), "-o", str(out))
    page = out / "episodes.html"
    page.write_text(page.read_text().replace(str(data.resolve()), "datasets/stack"))
    # Photographs have more shades than the colors that `MAXCOVERAGE` keeps.
    screenshot(page, BUILD / f"{name}.png", EPISODES[name], Image.Quantize.MEDIANCUT)


def main(names: Sequence[str]) -> None:
    """Draw the images that are named, by default all."""
    BUILD.mkdir(parents=True, exist_ok=True)
    draw = {
        **dict.fromkeys(VIEWS, draw_view),
        **dict.fromkeys(REPORTS, draw_report),
        **dict.fromkeys(EPISODES, draw_episodes),
    }
    for name in names or draw:
        draw[name](name)


if __name__ == "__main__":
    main(sys.argv[1:])
