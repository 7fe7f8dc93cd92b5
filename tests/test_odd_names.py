"""Names that no log can hold or no disk takes: one clear line before any work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import Cdmisfa
from mcap.writer import Writer

from cdmisfa.core.untrusted import printable

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


HOSTILE = "\x1b[31m\x07a\u202ecod\x9b2J"
ESCAPED = r"\x1b[31m\x07a\u202ecod\x9b2J"


def hostile_log(folder: Path) -> Path:
    """A log with such a name, topic, frame, schema and metadata."""
    path = folder / f"{HOSTILE}.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("cdmisfa.recording", {"seed": HOSTILE})
        schema = writer.register_schema(name=HOSTILE, encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(HOSTILE, "json", schema)
        writer.add_message(channel, log_time=0, data=b"{}", publish_time=0)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "words", ["info", "verify", "learn", "convert -o rec", "export -o x.parquet"]
)
def test_names_in_logs_do_not_steer_the_terminal(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = cdmisfa(*words.split(), hostile_log(tmp_path))
    shown = done.out + done.err
    assert ESCAPED in shown
    assert shown.replace("\n", "").isprintable()


def test_what_prints_is_shown_as_it_is() -> None:
    assert printable("Größe ε, 東京 'x' \\ \N{ROBOT FACE}") == "Größe ε, 東京 'x' \\ \N{ROBOT FACE}"
    assert printable("a\nb\u2066c\u2028\x7f\udcff") == r"a\nb\u2066c\u2028\x7f\udcff"


LONG = "d/" * 2500 + "log.mcap"


@pytest.mark.parametrize("words", ["info", "verify", "learn", "view", "check", "recover -o x.mcap"])
def test_a_path_of_thousands_of_letters_is_one_line(cdmisfa: Cdmisfa, words: str) -> None:
    done = cdmisfa(*words.split(), LONG)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"cdmisfa: {LONG[:20]}... has 5008 letters: choose a shorter path\n"


@pytest.mark.parametrize("words", COMMANDS)
def test_what_is_too_long_is_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    line = refusal(words, b"n" * 300, tmp_path)
    assert line == f"cdmisfa: {'n' * 20}... has 300 letters: choose a shorter name"
