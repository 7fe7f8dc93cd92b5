"""Read the results of a run from its folder: learner, streams, modules and their slowness.

The files of a run may come from anywhere: fields that make no sense are left out.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.signals import STATES
from replay.integrity.report import ModuleInfo
from replay.logs.stream import ChannelInfo
from replay.runs.folders import RUN_FILE, read_run_json, run_log
from replay.runs.log import SIGNALS_TOPIC, read_header
from replay.runs.modules import load_modules

# Errors of reading fields of a document whose structure is unknown.
_NO_SENSE: Final = (LookupError, TypeError, ValueError, AttributeError, OverflowError)


def run_facts(place: Path, channels: Sequence[ChannelInfo]) -> dict[str, Any]:
    """Return the results of a run as fields of a report; empty if the place is not a run.

    Args:
        place: the folder of the run, or its log.
        channels: channels of its log.
    """
    try:
        log = run_log(place)
    except CdmisfaError:
        return {}
    if not log.name.startswith(RUN_FILE):
        return {}
    folder, facts = log.parent, dict[str, Any]()
    result = read_run_json(folder).get("result")
    result = result if isinstance(result, Mapping) else {}
    with contextlib.suppress(CdmisfaError):
        facts["modules"] = tuple(map(ModuleInfo.of, load_modules(folder)))
    if result.get("ended") is not None:
        facts["ended"] = str(result["ended"])
    with contextlib.suppress(*_NO_SENSE):
        stated = result["held_out"]
        facts["held_out"] = {
            **{key: [int(t) for t in stated[key]][:2] for key in ("frames", "fitted")},
            "modules": [
                {"module": int(entry["module"]), "stream": str(entry["stream"])}
                | {
                    key: [math.nan if v is None else float(v) for v in entry[key]]
                    for key in ("slowness", "of_batch")
                }
                for entry in stated["modules"]
            ],
        }
    outcomes: list[Mapping[str, Any]] = []
    with contextlib.suppress(*_NO_SENSE):
        for stated in result["streams"]:
            outcomes.append(
                {
                    "stream": str(stated["stream"]),
                    "state": STATES[STATES.index(stated["state"])],  # refuses an unknown state
                    "module": None if stated["module"] is None else int(stated["module"]),
                    "blocks": int(stated["blocks"]),
                    "slowness": None if stated["slowness"] is None else float(stated["slowness"]),
                    "why": str(stated["why"]),
                }
            )
    with contextlib.suppress(CdmisfaError, TypeError, ValueError):
        header = read_header(folder)
        facts["run"] = {
            "algorithm": str(header.setting("learner", "algorithm")),
            "streams": header.spec.streams,
            "tau": int(header.setting("learner", "tau")),
            "iterations": sum(c.messages for c in channels if c.topic == SIGNALS_TOPIC),
            "outcomes": outcomes,
        }
    return facts
