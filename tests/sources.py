"""The project's own files, for tests that read them: product code, its strings, documents."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PRODUCT = ("cdmisfa", "recorder", "replay")

README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
DOCUMENTS = [README, ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *DOCS]


def files(*folders: str, suffixes: tuple[str, ...] = (".py",)) -> Iterator[Path]:
    """Yield source files below folders, by default those of the product."""
    for folder in folders or PRODUCT:
        for file in sorted((ROOT / folder).rglob("*")):
            if file.suffix in suffixes and "build" not in file.relative_to(ROOT).parts:
                yield file


@cache
def tree(file: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(file.read_text("utf-8"), name(file))


def name(path: Path) -> str:
    """Return the path of a file within the project."""
    return path.relative_to(ROOT).as_posix()


def strings(node: ast.AST) -> Iterator[str]:
    """Yield all strings; those of an f-string are the parts between its values."""
    for each in ast.walk(node):
        if isinstance(each, ast.Constant) and isinstance(each.value, str):
            yield each.value
