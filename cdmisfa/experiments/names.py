"""Runs from before streams had one name each, whose streams are called by their topics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cdmisfa.core.blocks import stream_names
from cdmisfa.core.learning import LearnerState


def same_names(then: Sequence[str], now: Sequence[str]) -> bool:
    """Whether the streams of a source now are those of before."""
    return tuple(now) in (tuple(then), stream_names(then))


def named(state: LearnerState, streams: Sequence[str]) -> LearnerState:
    """A state whose modules call their streams as a source does now."""
    modules = [
        replace(module, stream=streams[module.stream_index])
        if 0 <= module.stream_index < len(streams)
        else module
        for module in state.modules
    ]
    return replace(state, modules=tuple(modules))


def renamed(value: Any, names: Mapping[str, str]) -> Any:
    """JSON values with other names as keys."""
    if isinstance(value, Mapping):
        return {names.get(key, key): renamed(part, names) for key, part in value.items()}
    return [renamed(part, names) for part in value] if isinstance(value, list) else value
