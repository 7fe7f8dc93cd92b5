"""The project's shape: layers, packages, a quick command line, pages that cannot drift."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest
from conftest import Cdmisfa

from cdmisfa.cli.app import COMMANDS, cli

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PACKAGES = ("cdmisfa", "recorder", "replay")
HEAVY = ("numpy", "numba", "rerun", "pybullet", "matplotlib", "pyarrow", "mcap", "rich")


def python(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *args], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )


def test_imports_run_one_way() -> None:
    code = (
        "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stdout


def test_no_module_of_the_mind_escapes_the_rules() -> None:
    contracts = PYPROJECT["tool"]["importlinter"]["contracts"]
    ruled = next(c["source_modules"] for c in contracts if c["name"].startswith("The mind"))
    found = {
        f"cdmisfa.{path.stem}"
        for path in (ROOT / "cdmisfa").iterdir()
        if (path.suffix == ".py" or (path / "__init__.py").exists()) and path.stem[0] != "_"
    }
    assert found - {"cdmisfa.cli", "cdmisfa.experiments"} == set(ruled)


def test_every_package_is_listed() -> None:
    found = {
        ".".join(file.parent.relative_to(ROOT).parts)
        for name in PACKAGES
        for file in (ROOT / name).rglob("__init__.py")
    }
    assert set(PYPROJECT["tool"]["setuptools"]["packages"]) == found


@pytest.mark.parametrize("package", PACKAGES)
def test_every_folder_with_modules_is_a_package(package: str) -> None:
    folders = {file.parent for file in (ROOT / package).rglob("*.py")}
    assert [f for f in folders if not (f / "__init__.py").exists()] == []


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from cdmisfa.cli import run; run(['--help']);"
        f"print(sorted(set({HEAVY!r}) & set(sys.modules)), file=sys.stderr)"
    )
    assert python("-c", code).stderr.strip() == "[]"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_that_the_group_repeats(name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert command.name == name
    assert (command.help or "").partition("\n")[0] == COMMANDS[name][1]
    undocumented = [
        p.name for p in command.params if isinstance(p, click.Option) and not (p.help or p.hidden)
    ]
    assert undocumented == []


def test_every_command_is_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert [name for name in COMMANDS if f"cdmisfa {name}" not in text] == []


def test_page_of_signals_is_what_the_command_prints(cdmisfa: Cdmisfa) -> None:
    page = (ROOT / "docs" / "signals.md").read_text("utf-8")
    assert cdmisfa("signals", "--markdown").out == page, (
        "make it again: cdmisfa signals --markdown > docs/signals.md"
    )
