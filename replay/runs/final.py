"""The final record of a run: the hashes of its signals and of what lies beside its log."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from replay.runs.folders import MODULES_FILE
from replay.storage.checksum import sha256


def final_record(
    folder: Path, document: Mapping[str, Any], signals: str, *, view: bool
) -> dict[str, str]:
    """What a run's log states last, of a folder that holds its modules already.

    Args:
        folder: of the run.
        document: what its run.json states.
        signals: the SHA-256 of its signals.
        view: whether it has a view, too.
    """
    return {
        "signals_sha256": signals,
        "modules_sha256": sha256(folder / MODULES_FILE),
        "facts_sha256": facts_sha256(document),
        "view": json.dumps(view),
    }


def facts_sha256(document: Mapping[str, Any]) -> str:
    """SHA-256 of what a run.json states, but for where the run lies and how it was called."""
    facts = {key: value for key, value in document.items() if key != "command"}
    if isinstance(result := facts.get("result"), Mapping):
        facts["result"] = {key: value for key, value in result.items() if key != "run"}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
