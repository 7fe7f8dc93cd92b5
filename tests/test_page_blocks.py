"""Blocks of the pages work as printed: commands with their output, Python and copied commands."""

from __future__ import annotations

import doctest
import importlib.util
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import Cdmisfa
from sources import DOCS, README, ROOT, name

BLOCK = re.compile(r"^```(console|sh|python|pycon)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

# Packages without which the code of a page cannot run.
PACKAGES = (
    "pybullet",
    "duckdb",
    "polars",
    "gymnasium",
    "river",
    "sklearn",
    "matplotlib",
    "rosbags",
)

# Pages that readers follow in a checkout: .gitignore covers the files that their commands write.
IN_A_CHECKOUT = ("README", "first-run", "own-logs", "record", "look-at-a-run", "use-modules")


def with_blocks() -> list[Path]:
    return [page for page in (README, *DOCS) if BLOCK.search(page.read_text("utf-8"))]


def missing_packages(text: str) -> list[str]:
    """Return the packages that the blocks of a page need and that are not installed."""
    needed = [name for name in PACKAGES if re.search(rf"(?:import|from) {name}\b", text)]
    if re.search(r"cdmisfa (?:-q )?(?:record icub|learn icub|demo|reproduce icub)", text):
        needed.append("pybullet")
    return [name for name in needed if importlib.util.find_spec(name) is None]


def commands(block: str) -> Iterator[tuple[str, str]]:
    """Yield the commands of a console block, which begin with "$ ", and the output of each."""
    block = block.replace("\\\n", " ")
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, _, output = part.partition("\n")
        yield command, output


def as_pattern(output: str) -> str:
    """Return a regular expression of an output in which "..." is any text, also none."""
    words = " ".join(output.split())
    return re.escape(words).replace(r"\ \.\.\.\ ", r"(?: .*)? ?").replace(r"\.\.\.", ".*")


class Page:
    """A folder and a namespace in which the blocks of one page run in order."""

    def __init__(self, cdmisfa: Cdmisfa, name: str) -> None:
        self.cdmisfa = cdmisfa
        self.namespace: dict[str, Any] = {"__name__": name}

    def command(self, line: str) -> tuple[int, str]:
        """Run a command line and return its exit code and what it printed."""
        if line.startswith("cdmisfa ") and not re.search(r"[|&;<>*$]|^#", line):
            outcome = self.cdmisfa(*shlex.split(line, comments=True)[1:])
            return outcome.code, outcome.err + outcome.out
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-c", line],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=100,
            env={**os.environ, "PATH": path},
        )
        return done.returncode, done.stdout

    def run(self, language: str, block: str) -> None:
        """Run a block; an output that differs from the printed one fails."""
        if language == "python":
            exec(compile(block, "page", "exec"), self.namespace)
        elif language == "pycon":
            flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
            test = doctest.DocTestParser().get_doctest(block, self.namespace, "page", None, None)
            assert doctest.DocTestRunner(optionflags=flags).run(test, clear_globs=False).failed == 0
            self.namespace.update(test.globs)
        elif language == "sh":
            for line in block.replace("\\\n", " ").splitlines():
                if line.strip() and not line.startswith("#"):
                    code, printed = self.command(line)
                    assert code == 0, f"{line}: {printed}"
        else:
            for line, output in commands(block):
                code, printed = self.command(line)
                match = re.fullmatch(as_pattern(output), " ".join(printed.split()), re.DOTALL)
                assert match, (
                    f"{line} prints (exit code {code}):\n{printed}\nthe page has:\n{output}"
                )
                # Such an output matches an error as well.
                assert code == 0 or set(output.split()) != {"..."}, f"{line}: {printed}"


@pytest.mark.parametrize("page", with_blocks(), ids=name)
def test_blocks_of_a_page_work_as_printed(
    page: Path, cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = page.read_text("utf-8")
    if missing := missing_packages(text):
        pytest.skip(f"missing: {', '.join(missing)}")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setenv("COLUMNS", "100")
    run = Page(cdmisfa, page.stem)
    for language, block in BLOCK.findall(text):
        run.run(language, block)
    if page.stem in IN_A_CHECKOUT:
        assert untracked(tmp_path) == {".gitignore", "examples", "sample_logs"}


def untracked(folder: Path) -> set[str]:
    """Return what git would add in a folder with the project's .gitignore."""
    (folder / ".gitignore").write_text((ROOT / ".gitignore").read_text("utf-8"))
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    status = ["git", "status", "--porcelain"]
    done = subprocess.run(status, cwd=folder, capture_output=True, text=True, check=True)
    return {line.removeprefix("?? ") for line in done.stdout.splitlines()}


def test_a_block_that_differs_fails(cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    page = Page(cdmisfa, "page")
    page.run("console", "$ cdmisfa --version\ncdmisfa ...\n$ echo a b\na\n  b\n")
    page.run("pycon", ">>> 1 + 1\n2\n")
    for language, block in (
        ("console", "$ echo a\nb\n"),
        ("console", "$ echo a\n"),
        ("console", "$ false\n...\n"),
        ("sh", "false\n"),
        ("pycon", ">>> 1\n2\n"),
    ):
        with pytest.raises(AssertionError):
            page.run(language, block)


def test_first_block_of_the_readme_has_the_two_targets_of_the_makefile() -> None:
    makefile = (ROOT / "Makefile").read_text("utf-8")
    first = re.findall(r"^```\w*\n(.*?)^```$", README.read_text("utf-8"), re.M | re.S)[0]
    targets = re.findall(r"^(?:\$ )?make (\w+)", first, re.MULTILINE)
    assert targets == ["demo", "test"]
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
