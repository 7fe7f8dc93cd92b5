"""Names that no log can hold or no disk takes: one clear line before any work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = (
    ("record", "oscillatory", "--frames", "10"),
    ("learn", "oscillatory", "--max-iterations", "3"),
    ("sweep", "oscillatory", "--seeds", "0:1", "--max-iterations", "3"),
)


def refusal(words: tuple[str, ...], out: bytes, folder: Path) -> str:
    """The one line with which a command refuses to write at such a path."""
    ended = subprocess.run(
        [os.fsencode(sys.executable), "-m", "cdmisfa", *words, "-o", out],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)},
        capture_output=True,
        check=False,
    )
    assert (ended.returncode, ended.stdout) == (2, b"")
    (line,) = ended.stderr.decode().splitlines()
    assert list(folder.iterdir()) == []
    return line


@pytest.mark.parametrize("words", COMMANDS)
def test_what_is_not_utf_8_is_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    line = refusal(words, b"caf\xe9", tmp_path)
    assert line == "cdmisfa: caf\\xe9 is not UTF-8: give it another name"


@pytest.mark.parametrize("words", COMMANDS)
def test_what_is_too_long_is_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    line = refusal(words, b"n" * 300, tmp_path)
    assert line == f"cdmisfa: {'n' * 20}... has 300 letters: choose a shorter name"
