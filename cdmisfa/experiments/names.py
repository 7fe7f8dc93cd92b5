"""Runs from before streams had one name each, whose streams are called by their topics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.learning import LearnerState
from cdmisfa.core.names import stream_names


def same_names(then: Sequence[str], now: Sequence[str]) -> bool:
    """Whether the streams of a source now are those of before."""
    return tuple(now) in (tuple(then), stream_names(then))


def placed(state: LearnerState, spec: SourceSpec) -> LearnerState:
    """A state whose modules are of a source's streams, by their names now, and frames."""
    names = dict(enumerate(spec.streams))
    modules = [
        replace(
            module,
            stream=names.get(module.stream_index, module.stream),
            frame_shape=spec.frame_shape,
        )
        for module in state.modules
    ]
    return replace(state, modules=tuple(modules))


def renamed(value: Any, names: Mapping[str, str]) -> Any:
    """JSON values with other names as keys."""
    if isinstance(value, Mapping):
        return {names.get(key, key): renamed(part, names) for key, part in value.items()}
    return [renamed(part, names) for part in value] if isinstance(value, list) else value
