"""What was learned in a run, as its folder says: by which learner, of which streams, and how slow.

Files of a run may come from anywhere: what is none of it is left out.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.signals import STATES
from cdmisfa.modules import Module
from replay.runs.folders import RUN_FILE, read_run_json, run_log
from replay.runs.log import read_header
from replay.runs.modules import load_modules


@dataclass(frozen=True, slots=True)
class ModuleInfo:
    """A module: the slowness of each output, and 1 or 0 where it is known to be slow or not.

    Attributes:
        iteration: at whose end it was saved.
        policy: that led to it; of each stream 0 to stay and 1 to switch.
    """

    index: int
    stream: str
    slowness: tuple[float, ...]
    slow: tuple[int, ...]
    iteration: int
    policy: tuple[int, ...]

    @classmethod
    def of(cls, module: Module) -> ModuleInfo:
        """A module in short."""
        slowness, slow, policy = (
            tuple(m.tolist()) for m in (module.eta, module.slow, module.policy)
        )
        return cls(module.index, module.stream, slowness, slow, module.iteration, policy)


@dataclass(frozen=True, slots=True)
class RunInfo:
    """How a run was learned.

    Attributes:
        algorithm: name of its learner.
        streams: names of what it learned from.
        tau: frames of an iteration.
        iterations: that are in its log.
        outcomes: what became of each stream, where its learner says so: its `stream`, `state`,
            `module`, `blocks`, `slowness` and `why`.
    """

    algorithm: str
    streams: tuple[str, ...]
    tau: int
    iterations: int
    outcomes: tuple[Mapping[str, Any], ...]

    @classmethod
    def of(cls, run: Path, result: Mapping[str, Any], iterations: int) -> RunInfo | None:
        """How the run in a folder was learned; None where its log does not say.

        Args:
            run: the folder.
            result: see `result_of`.
            iterations: in its log.
        """
        with contextlib.suppress(CdmisfaError, TypeError, ValueError):
            header = read_header(run)
            told, tau = (header.setting("learner", key) for key in ("algorithm", "tau"))
            outcomes = tuple(_outcomes(result))
            return cls(str(told), header.spec.streams, int(tau), iterations, outcomes)
        return None


def run_folder(place: Path) -> Path | None:
    """The folder of the run that a place is, if it is one."""
    with contextlib.suppress(CdmisfaError):
        log = run_log(place)
        return log.parent if log.name.startswith(RUN_FILE) else None
    return None


def result_of(run: Path) -> Mapping[str, Any]:
    """What run.json says that a run came to; nothing where it does not say."""
    result = read_run_json(run).get("result")
    return result if isinstance(result, Mapping) else {}


def modules_of(run: Path) -> tuple[ModuleInfo, ...]:
    """The modules in a run's folder; none where their file cannot be read."""
    with contextlib.suppress(CdmisfaError):
        return tuple(map(ModuleInfo.of, load_modules(run)))
    return ()


def held_out_of(result: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """How slow modules are on frames that were held out, as a result says."""
    with contextlib.suppress(LookupError, TypeError, ValueError, AttributeError):
        found = result["held_out"]
        numbers = ("slowness", "of_batch")
        return {
            **{key: [int(t) for t in found[key]][:2] for key in ("frames", "fitted")},
            "modules": [
                {"module": int(one["module"]), "stream": str(one["stream"])}
                | {key: [math.nan if v is None else float(v) for v in one[key]] for key in numbers}
                for one in found["modules"]
            ],
        }
    return None


def _outcomes(result: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """What became of each stream, as a result says."""
    with contextlib.suppress(LookupError, TypeError, ValueError, AttributeError):
        for one in result["streams"]:
            if one["state"] not in STATES:
                return
            yield {
                "stream": str(one["stream"]),
                "state": one["state"],
                "module": None if one["module"] is None else int(one["module"]),
                "blocks": int(one["blocks"]),
                "slowness": None if one["slowness"] is None else float(one["slowness"]),
                "why": str(one["why"]),
            }
