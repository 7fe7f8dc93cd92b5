"""Every equation of the paper is one function that says so, and the docs know it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache

import pytest
from sources import ROOT, files, name, tree

PAGES = ("docs/project/contributing.md", "docs/how-to/find-bad-episodes.md")
EQUATIONS = [str(number) for number in range(1, 10)]
EQUATIONS += [f"P{number}" for number in range(1, 5)] + [f"E{number}" for number in range(1, 21)]
"""The paper's equations, the progress learner's, and those of reasons of bad episodes."""

LINE = re.compile(r"^\s*Equation:(.*)$", re.MULTILINE)
ROW = re.compile(r"^\| \(([PE]?\d+)\) \|.*?\| `([\w/]+\.(?:py|c))` `(\w+)` \|$", re.MULTILINE)
IN_C = re.compile(r"/\*((?:(?!\*/).)*)\*/\n[^\n;{(]*?(\w+)\(", re.DOTALL)
"""A comment in C, and the function that it stands before."""

Place = tuple[str, str]


@cache
def stated() -> list[tuple[str, Place]]:
    """Every `Equation:` line of a docstring or comment: what it says, and of which function."""
    return list(_stated())


def _stated() -> Iterator[tuple[str, Place]]:
    for file in files():
        for node in ast.walk(tree(file)):
            if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
                for text in LINE.findall(ast.get_docstring(node) or ""):
                    yield text.strip(), (name(file), getattr(node, "name", ""))
    for file in files("cdmisfa/kernels", suffixes=(".c",)):
        for comment, function in IN_C.findall(file.read_text("utf-8")):
            for text in LINE.findall(comment.replace("\n *", "\n")):
                yield text.strip(), (name(file), function)


def stated_by_number() -> dict[str, set[Place]]:
    places: dict[str, set[Place]] = {}
    for text, place in stated():
        places.setdefault(text, set()).add(place)
    return places


@pytest.mark.parametrize("number", EQUATIONS)
def test_equation_is_in_the_code(number: str) -> None:
    assert number in stated_by_number()


def test_every_equation_line_names_one_equation_of_a_page() -> None:
    dangling = [(text, place) for text, place in stated() if text not in EQUATIONS]
    assert dangling == []


def test_equations_are_functions() -> None:
    assert [place for _, place in stated() if not place[1] or place[1][0].isupper()] == []


def test_the_page_says_where_every_equation_is() -> None:
    listed: dict[str, set[Place]] = {}
    text = "".join((ROOT / page).read_text("utf-8") for page in PAGES)
    for number, file, function in ROW.findall(text):
        listed.setdefault(number, set()).add((file, function))
    assert listed == stated_by_number()
