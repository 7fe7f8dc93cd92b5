"""Logs on servers that lie, in each way of `server_lies`: the right bits, or one line, in time."""

from __future__ import annotations

from pathlib import Path

from replay.storage import servers

from .outcomes import CLEAR_ERROR, RIGHT, Defect, Job, Limits, Outcome
from .server_cases import CASES, Given, WrongError, check
from .server_cases import prepare as made

LIMITS = Limits(seconds=60, megabytes=512, enough=len(CASES), beside=2, share=2)


def prepare(folder: Path) -> Given:
    """The logs, and what the commands say of them as files."""
    return made(folder)


def case(job: Job) -> Outcome:
    """One lie, about one log, to one command."""
    servers.FIRST_WAIT = 0.02
    chosen = CASES[job.seed % len(CASES)]
    try:
        told = check(chosen, job.given, job.folder / "out", job.seed)
    except WrongError as error:
        raise Defect(error.kind, chosen.command, str(error)) from None
    detail = f"{chosen.lie}: {told}"
    return Outcome(RIGHT if told == "right" else CLEAR_ERROR, chosen.command, detail)
