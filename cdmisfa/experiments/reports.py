"""Reports: one HTML page with the results of a run, or with a comparison of runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.experiments.resume import Recomputation
from cdmisfa.experiments.run_folder import command_again
from recorder.log.files import atomic_write, refuse_taken, refuse_unless
from replay.runs.folders import REPORT_FILE, run_log, runs_in


def write_report(
    words: Sequence[str | Path], out: Path | None = None, *, force: bool = False
) -> Path:
    """Write the report of a run, of several runs or of a folder of runs.

    Args:
        words: paths of the runs.
        out: the file (.html); None: `report.html` in the folder of the run, replaced.
        force: True to replace an existing file.

    Returns:
        The file.

    Raises:
        UsageError: a run does not exist, or the file exists.
        LogDamagedError: a run is damaged; if its header is readable, the file of the readable part
            was written.
        LogWriteError: the file cannot be written.
    """
    paths = [Path(word) for word in words]
    if out is None:
        if len(paths) != 1 or runs_in(paths[0]):
            raise UsageError("a report of several runs needs a file: add -o report.html")
        out, force = run_log(paths[0]).parent / REPORT_FILE, True
    refuse_unless(out, "a report is an HTML page", ".html", ".htm")
    refuse_taken(out, force=force)
    from replay.report.page import report_of_run, report_of_runs

    damage: list[str] = []
    if len(paths) > 1:
        page = report_of_runs(paths, f"{len(paths)} runs compared")
    elif runs := runs_in(paths[0]):
        page = report_of_runs(runs, f"{paths[0].resolve().name}: {len(runs)} runs")
    else:
        again = _reproducible(paths[0]), command_again(paths[0])
        page, damage = report_of_run(paths[0], *again)
    with atomic_write(out) as partial:
        partial.write_text(page, encoding="utf-8")
    if damage:
        raise LogDamagedError(f"{out} was written. {damage[0]}")
    return out


def _reproducible(run: Path) -> str:
    """Return whether learning a run again is expected to give the same bits, as a sentence.

    The check compares the version of the arithmetic and the source, without learning and without
    reading all of the source.
    """
    try:
        with Recomputation(run, 0) as recomputation:
            recomputation.source  # noqa: B018, opens the source
            changed = recomputation.other_files()
    except CdmisfaError as error:
        reason = str(error.__cause__ if isinstance(error.__cause__, CdmisfaError) else error)
        return f"no: {reason.partition(': did you mean')[0]}"
    if changed:
        return f"no: {', '.join(changed)} changed since"
    return "yes: its source is present and looks unchanged"
