"""Every equation of the paper is one function that says so, and the docs know it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EQUATIONS = range(1, 10)
LINE = re.compile(r"^\s*Equation:(.*)$", re.MULTILINE)
ROW = re.compile(r"^\| \((\d+)\) \|.*?\| `([\w/]+\.py)` `(\w+)` \|$", re.MULTILINE)

Place = tuple[str, str]


def stated() -> Iterator[tuple[str, Place]]:
    """Every `Equation:` line of a docstring: what it says, and of which function."""
    for package in ("cdmisfa", "recorder", "replay"):
        for file in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text("utf-8"))):
                if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
                    name = getattr(node, "name", "")
                    for text in LINE.findall(ast.get_docstring(node) or ""):
                        yield text.strip(), (file.relative_to(ROOT).as_posix(), name)


def stated_by_number() -> dict[int, set[Place]]:
    places: dict[int, set[Place]] = {}
    for text, place in stated():
        places.setdefault(int(text), set()).add(place)
    return places


@pytest.mark.parametrize("number", EQUATIONS)
def test_equation_is_in_the_code(number: int) -> None:
    assert number in stated_by_number()


def test_every_equation_line_names_one_equation_of_the_paper() -> None:
    dangling = [(t, p) for t, p in stated() if not t.isdigit() or int(t) not in EQUATIONS]
    assert dangling == []


def test_equations_are_functions() -> None:
    assert [place for _, place in stated() if not place[1] or place[1][0].isupper()] == []


def test_the_page_says_where_every_equation_is() -> None:
    page = (ROOT / "docs" / "algorithm.md").read_text("utf-8")
    listed: dict[int, set[Place]] = {}
    for number, file, name in ROW.findall(page):
        listed.setdefault(int(number), set()).add((file, name))
    assert listed == stated_by_number()
