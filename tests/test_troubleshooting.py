"""Error texts on the page of troubleshooting are those that users see."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
from mcap.reader import make_reader
from sources import ROOT, files, strings, tree

PAGE = (ROOT / "docs" / "troubleshooting.md").read_text("utf-8")
TEXTS = "".join(re.findall(r"^```text\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)).splitlines()
OURS = [line.partition(": ")[2] for line in TEXTS if line.startswith("cdmisfa: ")]
OURS += re.findall(r"^\| `([^`]+)` \|", PAGE, re.MULTILINE)


@cache
def literals() -> set[str]:
    """Return the strings of the program."""
    texts = (text.strip() for file in files() for text in strings(tree(file)))
    return {text for text in texts if len(text) > 5}


@pytest.mark.parametrize("text", OURS)
def test_texts_of_ours_are_in_the_code(text: str) -> None:
    """Values take at most a third of a text, all else is in the code."""
    missing = 0
    for piece in text.split("..."):
        if any(piece.strip(" ()") in literal for literal in literals()):
            continue
        for literal in sorted(
            (text for text in literals() if text in piece), key=len, reverse=True
        ):
            piece = piece.replace(literal, "")
        missing += len(piece)
    assert missing <= len(text) / 3


def test_texts_of_mcap_are_those_that_it_raises(tmp_path: Path) -> None:
    data = (ROOT / "sample_logs" / "icub" / "left.mcap").read_bytes()
    damaged = {"cut": data[:500_000], "empty": b"", "magic": b"x" * 100}
    damaged["chunk"] = data[:200_000] + b"XXXX" + data[200_004:]
    for name, content in damaged.items():
        (tmp_path / name).write_bytes(content)
        with (tmp_path / name).open("rb") as file, pytest.raises(Exception) as caught:  # noqa: PT011
            list(make_reader(file).iter_messages())
        kind = f"{caught.type.__module__}.{caught.type.__name__}"
        (line,) = [line for line in TEXTS if line.startswith(kind)]
        pieces = line[len(kind) :].lstrip(": ").split("...")
        assert all(piece.strip() in str(caught.value) for piece in pieces)
