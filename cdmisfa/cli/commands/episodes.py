"""`cdmisfa episodes`: which episodes of a dataset are bad, and why."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options, printing
from cdmisfa.cli.progress import bar
from cdmisfa.core.interrupts import stoppable
from cdmisfa.core.names import counted, duration_text

if TYPE_CHECKING:
    from replay.episodes.ranking import Ranked

# Flagged episodes that are printed, so that they fit on a screen; the table has all of them.
MOST_FLAGGED = 20


@options.command("episodes")
@click.argument("dataset", nargs=-1, required=True, type=options.WORD, metavar="DATASET...")
@options.output("Folder to write.", required=True)
@options.option("--by COLUMN", type=str)
@options.option("--state TOPIC", type=str, multiple=True)
@options.option("--action TOPIC", type=str, multiple=True)
@options.option("--jobs N", type=options.PROCESSES)
@options.as_json
@options.quiet
def episodes_command(
    dataset: tuple[str, ...],
    output: Path,
    by: str | None,
    state: tuple[str, ...],
    action: tuple[str, ...],
    jobs: int | None,
    as_json: bool,
) -> int:
    """Find bad episodes of a robot dataset, and say why.

    The command measures every image and all joint states of each episode and compares the episodes
    with each other: frozen, black or blurred images, a moved camera, a camera that lags behind the
    joints, states that do not follow the actions, and images unlike all other episodes. It
    writes episodes.parquet, with a row for each episode, and episodes.html, with images. When it
    runs again, it measures only new and changed episodes.

    DATASET is one of:
        datasets/pick         a LeRobot dataset
        takes                 a folder of logs, each an episode: MCAP, bag, video
        'takes/*.mcap'        a file, or a pattern that names several

    Options:
        --by COLUMN: Compare only episodes that have the same value in this column of the dataset,
            such as task, or folder. [default: task, and views that differ clearly]
        --state TOPIC: Read joint states from this topic, TOPIC:FIELD or feature.
            Repeatable. [default: JointState messages, observation.state]
        --action TOPIC: Read actions from this topic, TOPIC:FIELD or feature. Repeatable.
            [default: JointState messages on a topic named as command or action; action]
        --jobs N: Number of parallel processes. [default: number of processors]

    Examples:
        cdmisfa episodes datasets/pick -o check
        cdmisfa episodes takes -o check --by folder
        cdmisfa episodes takes -o check --state /arm/joints --action /arm/cmd
    """
    from replay.episodes.ranking import rank_episodes
    from replay.episodes.results import PAGE, TABLE, write_ranking

    with bar("measuring", "episodes") as progress_bar, stoppable() as stop:
        ranked = rank_episodes(
            dataset,
            output,
            by=by,
            topics={"state": state, "action": action},
            jobs=jobs or os.cpu_count() or 1,
            progress=progress_bar.update,
            stop=stop,
        )
        if ranked is None:
            printing.status("stopped before all episodes were measured: run the same command again")
            return stop.exit_code
        write_ranking(ranked, output, f"Episodes of {' '.join(dataset)}")
    if as_json:
        printing.document(
            episodes=ranked.rows(),
            flagged=ranked.flagged,
            groups={name: len(group) for name, group in ranked.groups.items()},
            notes=ranked.notes,
            remove=ranked.removal(),
            table=str(output / TABLE),
            page=str(output / PAGE),
        )
    else:
        _print_ranked(ranked)
        printing.line(f"results written to {output / TABLE} and {output / PAGE}")
    return 0


def _print_ranked(ranked: Ranked) -> None:
    """Print flagged episodes with their reasons, notes, and how to remove the episodes."""
    flagged = ranked.flagged
    seconds = sum(one.seconds for one in ranked.measured)
    printing.line(
        f"{counted(len(ranked.logs), 'episode')}, {duration_text(seconds)}: {len(flagged)} flagged"
    )
    if len(ranked.groups) > 1:
        sizes = (f"{name or 'others'} ({len(group)})" for name, group in ranked.groups.items())
        printing.line(f"compared within groups: {', '.join(sizes)}")
    if flagged:
        printing.table(
            ("episode", "score", "reasons"),
            [
                (
                    ranked.logs[i].name,
                    f"{ranked.score[i]:.1f}",
                    "; ".join(words for words, _ in ranked.reasons(i)),
                )
                for i in flagged[:MOST_FLAGGED]
            ],
        )
    if len(flagged) > MOST_FLAGGED:
        printing.line(f"and {len(flagged) - MOST_FLAGGED} more flagged episodes")
    for note in ranked.notes:
        printing.line(note)
    for text in ranked.removal():
        printing.line(text)
