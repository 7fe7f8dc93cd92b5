"""How Sphinx makes the site of the pages in this folder: `make docs`."""

from __future__ import annotations

import re
import sys
import tempfile
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import demonstrations
import generated

project = "cdmisfa"
author = copyright = "the maintainers of cdmisfa"
version = release = metadata.version("cdmisfa")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
html_theme = "furo"
html_favicon = "images/icon.svg"
html_title = f"cdmisfa {release}"
html_show_sourcelink = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
templates_path = ["templates"]
exclude_patterns = ["decisions", "images/README.md"]
smartquotes = False
highlight_language = "none"
myst_heading_anchors = 4
napoleon_use_ivar = True

# The copy button of a block takes the commands or statements, without prompts and output.
copybutton_prompt_text = r"\$ |>>> |\.\.\. "
copybutton_prompt_is_regexp = True
suppress_warnings = ["toc.not_included", "myst.xref_missing"]

# Files beside docs/ that pages include, and their pages on the site.
PAGES = {
    "README.md": "/index.md",
    "CONTRIBUTING.md": "/project/contributing.md",
    "CHANGELOG.md": "/project/changelog.md",
    "SECURITY.md": "/evidence/security.md",
}

SEARCH_WORDS = tomllib.loads(Path(__file__).with_name("search_words.toml").read_text("utf-8"))

_folder = tempfile.TemporaryDirectory()
RUNS = Path(_folder.name)


def make_runs(app: Any) -> None:
    """Make the runs that the gallery shows, and with them its table."""
    demonstrations.make_runs(RUNS)
    generated.TABLES["index_of_logs"] = lambda: demonstrations.index_table(RUNS)


def replace_tables(app: Any, name: str, text: list[str]) -> None:
    """Replace the lines {{ name }} of a page by tables that are made from the code."""
    text[0] = generated.replaced(text[0]).replace("../README.md)", "index.md)")


def add_search_words(app: Any, name: str, text: list[str]) -> None:
    """Put index entries, which the search rates highest, below the title of a page."""
    if words := SEARCH_WORDS.get(name):
        entries = ", ".join(f"! {word}" for word in words.split(", "))
        directive = f"```{{index}} {entries}\n```\n"
        title = re.search(r"^# .*\n", text[0], re.MULTILINE)
        end = title.end() if title else 0
        text[0] = f"{text[0][:end]}\n{directive}\n{text[0][end:]}"


def link_within_the_site(app: Any, path: Path, page: str, text: list[str]) -> None:
    """Make links of a file beside docs/, such as README, links of the site."""
    text[0] = text[0].replace("](docs/", "](/")
    for name, address in PAGES.items():
        text[0] = text[0].replace(f"]({name}", f"]({address}")


def escape_markup(*event: Any) -> None:
    """Docstrings are text, not reStructuredText: escape stars and underscores."""
    lines, code = event[-1], False
    for at, line in enumerate(lines):
        code = code and (not line or line[0] == " ")
        if code:
            continue
        words = re.split(r"(`+[^`]+`+)", line)
        words[::2] = [re.sub(r"\*|_(?=\W|$)", r"\\\g<0>", word) for word in words[::2]]
        words[1::2] = [f"``{word.strip('`')}``" for word in words[1::2]]
        lines[at] = "".join(words)
        if line.endswith(":") and lines[at + 1 : at + 2] == [""] and lines[at + 2][:1] == " ":
            lines[at], code = lines[at] + ":", True


def name_levels(app: Any, page: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """Give the captions of the sidebar, which furo calls headings, a level."""
    sidebar = context.get("furo_navigation_tree", "")
    sidebar = sidebar.replace('role="heading"', 'role="heading" aria-level="2"')
    context["furo_navigation_tree"] = sidebar


def add_demonstrations(app: Any, failure: Exception | None) -> None:
    """Put the reports of the gallery, and one run in Rerun's viewer, beside the pages."""
    if failure is None:
        demonstrations.add_reports(RUNS, Path(app.outdir))
        demonstrations.add_viewer(RUNS, Path(app.outdir))


def setup(app: Any) -> None:
    app.connect("builder-inited", make_runs)
    app.connect("source-read", replace_tables)
    app.connect("source-read", add_search_words)
    app.connect("include-read", link_within_the_site)
    app.connect("autodoc-process-docstring", escape_markup, priority=100)
    app.connect("html-page-context", name_levels, priority=900)
    app.connect("build-finished", add_demonstrations)
