"""Language of the project: ceilings for constructions and words that readers stumble over.

The counts are symptoms. What is wanted is plain technical English in the field's own words.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from interface import command_of
from sources import DOCUMENTS, files, name, strings, tree

from cdmisfa.cli.app import COMMANDS, cli
from replay.logs.formats.arrays import RECIPE as ARRAYS_RECIPE  # runs store it: it cannot change

# Pages that a script writes or that list decisions in a sentence each.
NOT_COUNTED = ("benchmarks.md", "decisions.md")

# Constructions without a subject or a noun; at most so many in each place.
VAGUE = re.compile(
    r"""\bwhat\ (?:is|was|came|became|stands|it|a|has|had|comes|goes)\b
    | \b(?:is|are|was|be|being)\ (?:said|told)\b
    | \btold\b | \bstands?\b | \banew\b | \bof\ others\b | \bgiven\ up\b
    | \bthose\ (?:of|that|which)\b | \bof\ which\b | \bcame\ to\b
    | \bgoes\ on\b | \bfor\ good\b | \bof\ late\b
    | (?<![\d.])\.\d  # a number without its leading zero""",
    re.IGNORECASE | re.VERBOSE,
)
VAGUE_NAME = re.compile(
    r"(?:^|_)(?:told|said|stood|stands|anew|own|gone|came|became|others|of_old|begun|known_as"
    r"|asked|held|kept|shown|found|there|heard)(?:_|$)"
)
CEILINGS = {"strings": 42, "names": 26, "documents": 8}
WORDS_OF_DOCUMENTS = 25_480

# Words that texts for users do not use, and the words that they use instead.
INSTEAD = {
    r"told": "reported, printed, set",
    r"given up": "rejected",
    r"what (?:came|became) of": "outcome, result, status",
    r"logs of others|foreign logs?": "external logs",
    r"anew": "again",
    r"pictures?": "image",
    r"of late": "recent",
    r"which is said|and says so": "prints a warning",
    r"brought back": "restored",
    r"in the midst": "in the middle",
    r"nothing to tune": "the constants with their sensitivity",
    r"salvage": "skip damaged parts",
}


def banned(text: str) -> list[str]:
    """Return the banned words of a text, each with the words around it and its replacement."""
    return [
        f"...{text[max(0, match.start() - 30) : match.end() + 30]}...: write {words}"
        for pattern, words in INSTEAD.items()
        for match in re.finditer(rf"\b(?:{pattern})\b", text, re.IGNORECASE)
    ]


def defined_names(module: ast.AST) -> Iterator[str]:
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def prose(text: str) -> str:
    """Return a page without its code blocks, code spans, links and images."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]*`|\]\([^)]*\)", " ", text)


def hand_written() -> Iterator[Path]:
    for page in DOCUMENTS:
        if page.parent.name not in ("decisions", "images") and page.name not in NOT_COUNTED:
            yield page


def test_few_constructions_are_vague() -> None:
    modules = [tree(file) for file in files()]
    counts = {
        "strings": sum(
            len(VAGUE.findall(text))
            for module in modules
            for text in strings(module)
            if len(text) > 20
        ),
        "names": sum(
            len(VAGUE_NAME.findall(defined.lower()))
            for module in modules
            for defined in defined_names(module)
        ),
        "documents": sum(len(VAGUE.findall(page.read_text("utf-8"))) for page in DOCUMENTS),
    }
    assert {kind: n for kind, n in counts.items() if n > CEILINGS[kind]} == {}


def test_pages_are_short() -> None:
    words = sum(len(page.read_text("utf-8").split()) for page in hand_written())
    assert words <= WORDS_OF_DOCUMENTS


@pytest.mark.parametrize("page", DOCUMENTS, ids=name)
def test_pages_use_the_words_of_the_field(page: Path) -> None:
    assert banned(prose(page.read_text("utf-8"))) == []


def test_help_uses_the_words_of_the_field() -> None:
    texts = [cli.get_help(click.Context(cli))]
    texts += [
        (command := command_of(word)).get_help(click.Context(command, info_name=word))
        for word in COMMANDS
    ]
    assert len(texts) == len(COMMANDS) + 1
    assert [problem for text in texts for problem in banned(text)] == []


def test_messages_use_the_words_of_the_field() -> None:
    """Strings of several words that are no docstrings are messages, as a rule."""
    problems = []
    for module in map(tree, files()):
        docstrings = {
            ast.get_docstring(node, clean=False)
            for node in ast.walk(module)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        }
        for text in strings(module):
            if " " in text and text not in docstrings and text != ARRAYS_RECIPE:
                problems += banned(text)
    assert problems == []
