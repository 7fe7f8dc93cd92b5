"""Keyframes of a run: the learner's whole state after some iterations, stored in its log.

`cdmisfa.Keyframe` holds the state's arrays one after the other in `values`, and in the JSON text
`facts` what each one is, and all else.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError, one_line
from cdmisfa.core.learning import Keyframe, LearnerState
from cdmisfa.core.untrusted import parse_json
from cdmisfa.modules import Module
from recorder.mcap.reader import LogReader
from replay.runs.codec import define_message, parsed
from replay.runs.folders import run_log
from replay.runs.modules import checked
from replay.storage.arrays import contents, stored_arrays

KEYFRAME_TOPIC = "/keyframe"
KEYFRAME_SCHEMA = "cdmisfa.Keyframe"

# Rises when the state of a learner changes its meaning.
KEYFRAME_VERSION = 1

_ABOUT_FACTS = "JSON: name, type and shape of each array, and more"
_MODULES = "modules."

# What of a module follows from the source, which the log's header states.
_OF_SOURCE = ("frame_shape", "recipe")
_FIELD = descriptor_pb2.FieldDescriptorProto
_KEYFRAME, KEYFRAME_DEFINITION = define_message(
    KEYFRAME_SCHEMA,
    "keyframe",
    [
        ("iteration", 1, _FIELD.TYPE_SFIXED64, False, "Iterations done"),
        ("t", 2, _FIELD.TYPE_SFIXED64, False, "Next frame"),
        ("facts", 3, _FIELD.TYPE_STRING, False, _ABOUT_FACTS),
        ("values", 4, _FIELD.TYPE_BYTES, False, "The arrays, one after the other"),
    ],
)


def read_keyframe(path: Path, last: int | None = None) -> Keyframe | None:
    """Return the newest keyframe of a run's log at or before `last` iterations, or None.

    Only the chunks that hold keyframes are read. What is no keyframe of this version is passed
    over.
    """
    newest = _keyframes(run_log(path), lambda k: last is None or k <= last, backwards=True)
    return next(newest, None)


def read_keyframes(path: Path, after: int) -> Iterator[Keyframe]:
    """Yield the keyframes of a run's log after more than `after` iterations, in order.

    Of two after the same iteration, as where a fork begins, the last one is the run's.
    """
    before: Keyframe | None = None
    for keyframe in _keyframes(run_log(path), lambda k: k > after):
        if before is not None and before.iteration != keyframe.iteration:
            yield before
        before = keyframe
    if before is not None:
        yield before


def _keyframes(
    log: Path, wanted: Callable[[int], bool], *, backwards: bool = False
) -> Iterator[Keyframe]:
    """Keyframes in the order of the file, or from its end on."""
    step = -1 if backwards else 1
    with LogReader(log) as reader:
        numbers = {n for n, channel in reader.channels.items() if channel.topic == KEYFRAME_TOPIC}
        for segment in reader.segments[::step]:
            counts = segment.channel_counts()
            if counts is not None and not numbers & counts.keys():
                continue
            table = reader.table(segment)
            if table is None:
                continue
            for row in np.flatnonzero(np.isin(table.channel, list(numbers)))[::step].tolist():
                if not wanted(int(table.records["sequence"][row])):
                    continue
                with contextlib.suppress(LogDamagedError):
                    keyframe = decode_keyframe(table.payload(row), f"{log} {KEYFRAME_TOPIC}")
                    if wanted(keyframe.iteration):
                        yield keyframe


def encode_keyframe(keyframe: Keyframe) -> bytes:
    """Return a keyframe as the bytes of a message."""
    state, arrays = keyframe.state, arrays_of(keyframe.state)
    facts = {
        "version": KEYFRAME_VERSION,
        "versions": keyframe.versions,
        "policy_rng": state.policy_rng,
        "arrays": contents(arrays),
    }
    encoded: bytes = _KEYFRAME(
        iteration=keyframe.iteration,
        t=keyframe.t,
        facts=json.dumps(facts),
        values=b"".join(array.tobytes() for array in arrays.values()),
    ).SerializeToString()
    return encoded


def arrays_of(state: LearnerState) -> dict[str, NDArray[Any]]:
    """Return all arrays of a state by name: its own, and one for each field of its modules.

    A field whose arrays have different shapes has one for each module, with its index from 0.
    """
    names = [field.name for field in dataclasses.fields(Module) if field.name not in _OF_SOURCE]
    arrays = dict(state.arrays)
    for name in names:
        values = [np.asarray(getattr(m, name)) for m in state.modules]
        if len({value.shape for value in values}) < 2:
            arrays[_MODULES + name] = np.array(values)
        else:  # modules for frames of different shapes
            arrays |= {f"{_MODULES}{name}.{i}": value for i, value in enumerate(values)}
    return arrays


def decode_keyframe(data: bytes, where: str = "record") -> Keyframe:
    """Return the keyframe in the bytes of a message, whose arrays are no larger than these.

    Raises:
        LogDamagedError: the bytes are not such a message, or one of another version.
    """
    decoded = parsed(_KEYFRAME, data, where)
    try:
        facts = parse_json(decoded.facts)
        if facts["version"] != KEYFRAME_VERSION:
            raise LogDamagedError(f"{where}: a keyframe of version {facts['version']!r}")
        arrays = stored_arrays(facts["arrays"], decoded.values)
        of_modules = [name for name in arrays if name.startswith(_MODULES)]
        columns: dict[str, Any] = {}
        for name in of_modules:
            field, _, index = name.removeprefix(_MODULES).partition(".")
            if not index:
                columns[field] = arrays.pop(name)
            else:
                columns.setdefault(field, []).append(arrays.pop(name))
        state = LearnerState(arrays, _modules(columns), dict(facts["policy_rng"]))
        return Keyframe(decoded.iteration, decoded.t, state, dict(facts["versions"]))
    # SystemError is NumPy's for text with code points that are no characters.
    except (LookupError, TypeError, ValueError, OverflowError, SystemError) as error:
        raise LogDamagedError(f"{where}: not a keyframe ({one_line(error)})") from error


def _modules(columns: Mapping[str, NDArray[Any] | list[NDArray[Any]]]) -> tuple[Module, ...]:
    values: Any = {
        name: column.tolist() if isinstance(column, np.ndarray) and column.ndim == 1 else column
        for name, column in columns.items()
    }
    rows = zip(*values.values(), strict=True)
    return tuple(checked(Module(**dict(zip(values, row, strict=True)))) for row in rows)
