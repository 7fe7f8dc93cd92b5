"""What a shell completes: files, scenes, presets, keys, runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click
from click.shell_completion import (
    BashComplete,
    CompletionItem,
    ShellComplete,
    ZshComplete,
    get_completion_class,
)

Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem[Any]]]

DEPTH = ("run.mcap", "*/run.mcap", "*/*/run.mcap")
"""Where runs are looked for below what was typed."""


class Bash(BashComplete):
    """Bash, where names of files are completed beside other words, and no space follows a `=`."""

    source_template = BashComplete.source_template.replace(
        "COMPREPLY=()\n            compopt -o default",
        'COMPREPLY+=($(compgen -f -- "${COMP_WORDS[COMP_CWORD]}"))\n'
        "            compopt -o filenames",
    ).replace(
        "COMPREPLY+=($value)",
        "COMPREPLY+=($value)\n            [[ $value == *= ]] && compopt -o nospace",
    )


class Zsh(ZshComplete):
    """Zsh, where files are whole words, as runs are: beside its own it drops what was typed."""

    source_template = ZshComplete.source_template.replace(
        "_path_files -f", "compadd -U -S '' -- ${~words[CURRENT]}*(NM)"
    )


OURS: Mapping[str, type[ShellComplete]] = {"bash": Bash, "zsh": Zsh}


def script(program: click.Command, shell: str) -> str:
    """What a shell reads to complete the commands of a program."""
    made = OURS.get(shell) or get_completion_class(shell)
    assert made is not None
    return made(program, {}, "cdmisfa", "_CDMISFA_COMPLETE").source()


def among(names: Callable[[], Iterable[str]], *, files: bool = False) -> Completer:
    """Complete one of some names, or a file where it may be one, too."""

    def complete(
        ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem[Any]]:
        found = [CompletionItem(name) for name in names() if name.startswith(incomplete)]
        return [CompletionItem(incomplete, type="file"), *found] if files else found

    return complete


def runs(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem[Any]]:
    """Complete the folder of a run, up to two folders deep, or any file."""
    folder, _, _ = incomplete.rpartition("/")
    place = Path(folder or ("/" if incomplete.startswith("/") else "."))
    found = {str(log.parent) for pattern in DEPTH for log in place.glob(pattern)}
    items = [CompletionItem(run) for run in sorted(found) if run.startswith(incomplete)]
    return [CompletionItem(incomplete, type="file"), *items]


def _sources() -> list[str]:
    from recorder.cameras.words import CAMERAS
    from recorder.world.scenes import SCENES

    return [*SCENES, *(f"{kind}:" for kind in CAMERAS)]


def _presets() -> Iterable[str]:
    from cdmisfa.core.config import presets

    return presets()


def _keys() -> Iterator[str]:
    from cdmisfa.agents.learners import LEARNERS
    from recorder.config import RecordConfig
    from recorder.world.scenes import SCENES

    of_learners = [("learner", entry.configuration) for entry in LEARNERS.values()]
    of_scenes = [("scene", entry.config) for entry in SCENES.values()]
    sections: list[tuple[str, type[Any]]] = [*of_learners, *of_scenes, ("record", RecordConfig)]
    keys = (key for section, config in sections for key in _keys_of(section, config()))
    yield from dict.fromkeys(f"{key}=" for key in keys)


def _keys_of(prefix: str, section: Any) -> Iterator[str]:
    for field in dataclasses.fields(section):
        key, value = f"{prefix}.{field.name}", getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            yield from _keys_of(key, value)
        else:
            yield key


sources, presets, keys = among(_sources, files=True), among(_presets, files=True), among(_keys)
