"""What others rely on is what is written down, and says so when it changes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import interface
from conftest import Cdmisfa

HOW = (
    "if that is meant, read docs/reference/stability.md, tell users in CHANGELOG.md, and write it "
    "down again: .venv/bin/python tests/interface.py"
)


def entries(value: Any, name: str = "") -> Iterator[str]:
    """Each thing that is written down, in a line."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from entries(inner, f"{name}{key}: ")
    elif isinstance(value, list):
        yield name
        for inner in value:
            yield f"{name}{inner}"
    else:
        yield f"{name}{value}"


def test_what_others_rely_on_is_what_was_written_down() -> None:
    snapshot = json.loads(interface.SNAPSHOT.read_text("utf-8"))
    before, now = set(entries(snapshot)), set(entries(interface.interface()))
    changes = [f"gone: {line}" for line in sorted(before - now)]
    changes += [f"new: {line}" for line in sorted(now - before)]
    assert not changes, "\n".join([*changes, HOW])


def test_the_page_states_the_versions_of_files() -> None:
    page = (interface.SNAPSHOT.parents[2] / "docs/reference/stability.md").read_text("utf-8")
    formats = interface.formats()
    stated = [
        f"| recording | {formats['recordings']} |",
        f"| `run.mcap` | {formats['signals']} |",
        f"| `corpus.parquet` | {formats['index of logs']} |",
        f"(`schema` is now {formats['JSON documents']})",
    ]
    assert [line for line in stated if line not in page] == []


def test_documents_on_stdout_are_versioned_and_alone(cdmisfa: Cdmisfa) -> None:
    snapshot = json.loads(interface.SNAPSHOT.read_text("utf-8"))
    assert [name for name, keys in snapshot["keys of --json"].items() if "schema" not in keys] == []
    with_json = {name for name, words in snapshot["commands"].items() if "--json" in words}
    looked_at = {name.partition(" ")[0] for name in snapshot["keys of --json"]}
    assert with_json - looked_at == {"demo", "reproduce"}
    assert cdmisfa("signals", "--json").json["schema"] == snapshot["formats"]["JSON documents"]
