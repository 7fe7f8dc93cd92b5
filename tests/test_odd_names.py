"""Names in logs do not steer the terminal."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Cdmisfa
from mcap.writer import Writer

from cdmisfa.core.untrusted import printable

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


@pytest.mark.parametrize("words", ["info", "verify", "learn", "convert -o rec"])
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
