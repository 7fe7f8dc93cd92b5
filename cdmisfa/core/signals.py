"""`BlockSignals`: the record of every signal of one iteration.

Every consumer walks over its fields: the schema of run.mcap, Rerun's entities and
layout, the columns of an export, the table of signals in the docs. Adding a signal is
adding a field and raising `SCHEMA_VERSION`. Its value is set in `agents/learner.py` and
`agents/progress/learner.py` or, if it is a scalar of the paper's iteration, is a field of
`OUTCOME` (`agents/agent.py`) set in `kernels/agent.c`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from operator import attrgetter, itemgetter
from typing import Any, Literal, NamedTuple

import numpy as np

from cdmisfa.core.arrays import FloatArray, IntArray

Show = Literal["line", "lane", "heat", "text", "hidden"]

# Names of the codes of an action, and of a stream's state (see the signal `state`).
ACTIONS = ("stay", "switch")
STATES = ("learning", "learned", "known", "given_up")

# Words of the states for people; `STATES` are the stored ones.
STATE_WORDS = ("not decided", "learned", "explained", "rejected")

# Code of a stream's state if the learner has no states.
NO_STATE = -1

# Version of the record. Raise it if a field of `BlockSignals` is added, removed or changes its
# meaning; runs of another version are refused.
SCHEMA_VERSION = 4


@dataclass(frozen=True, slots=True)
class Signal:
    """Description of a field of `BlockSignals`.

    Attributes:
        name: the field's name.
        symbol: the symbol in the paper, or "".
        equation: number of the paper's equation, or "" where it has none.
        unit: physical or natural unit; "1" for a pure number.
        dims: one letter a dimension: T frames of the block (tau), J outputs, M frozen
            modules, S streams, A actions. "" is a scalar.
        dtype: numpy name of the element type.
        show: how a viewer shows it.
        about: one sentence for a reader.
    """

    name: str
    symbol: str
    equation: str
    unit: str
    dims: str
    dtype: str
    show: Show
    about: str


# The element type of a field, by its annotation.
_DTYPES: Mapping[str, str] = {
    "int": "int64",
    "float": "float64",
    "bool": "bool",
    "IntArray": "int64",
    "FloatArray": "float64",
}


def _signal(
    symbol: str, dims: str = "", unit: str = "1", *, equation: str = "", show: Show | None = None
) -> Any:
    """Return a field; floats are shown as lines and others as lanes, by default."""
    facts = {"symbol": symbol, "dims": dims, "unit": unit, "equation": equation}
    return dataclasses.field(metadata={**facts, "show": show})


@dataclass(frozen=True, slots=True)
class BlockSignals:
    """Every internal signal of one iteration, that is of one block of tau frames.

    A signal that does not exist in an iteration (y of a block that was not novel, a
    reward in the warm-up) is NaN. `R` has shape (0, 2, 0) when there are more than
    `DENSE_STREAMS` streams. `SIGNALS` takes the descriptions from this text.

    Attributes:
        iteration: Number of the iteration, from 0.
        t: Frame number of the first frame of the block.
        log_time: Log time of the first frame of the block.
        stream: Attended stream, from 0.
        module: Number of the module being learned, from 1.
        novel: Whether the block is novel, so that the learner learns from it.
        known_by: Module that explains the block, from 1; 0 if none does, -1 if the block is
            constant.
        saved: Whether a module was saved at the end of the block.
        share: Recent share of blocks that were novel and of the same stream as the block before.
        novel_blocks: Number of novel blocks since the last module was saved.
        y: Outputs of the features being learned, on the block: slow features, then principal
            components.
        y_frozen: Output of each saved module on the block; NaN for modules that learned from frames
            of another shape or type, which the block cannot have.
        eta: Slowness of each output.
        eta_dot: Running mean of the change of slowness; a module is saved when it is below δ.
        variance: Recent variance of each output.
        eta_inst: Slowness of each output within the block.
        gate_mean: Running mean of η^inst.
        gate_sd: Running standard deviation of η^inst.
        eta_inst_frozen: Slowness of the outputs of each saved module within the block.
        band_mean: Mean of η^inst when the module was saved, for each module.
        band_sd: Standard deviation of η^inst when the module was saved; the module explains a block
            whose η^inst is within m_i ± 2 SD_i.
        roc_error_inst: Clustering error of the block: distance of the output from the nearest
            cluster centre (CD-MISFA 1.0 only).
        roc_error: Running mean of the clustering error; a module is saved when it is below a
            threshold (CD-MISFA 1.0 only).
        roc_error_frozen: Clustering error of each saved module; below the threshold the module
            explains the block (CD-MISFA 1.0 only).
        xi: Mean change of the weights over the block.
        xi_dot: Change of ⟨ξ⟩ since the last novel block.
        curiosity: Curiosity reward.
        expert: Expert reward.
        reward: Reward of the last transition.
        R: Running reward function.
        Q: Action value function.
        policy: Policy for each stream: 0 stay, 1 switch.
        epsilon: Probability of a random action; above 1 counts as 1.
        explored: Whether the action was chosen at random.
        action: Action after the block: 0 stay, 1 switch.
        next_stream: Stream attended next.
        change: Mean change of the candidate's outputs in a block, 0 to 1.41 (progress learner
            only).
        tested: Slowness of the candidate on frames before it learned from them (progress learner
            only).
        fitted: Slowness of the candidate on frames that it learned from (progress learner only).
        learning_error: Learning error of the candidate: c + |ln(η_test / η_fit)| (progress learner
            only).
        interest: Recent fall of the learning error of each stream, relative to the error; 0 if the
            stream is not being learned (progress learner only).
        state: State of each stream: 0 being learned, 1 learned, 2 explained by a module of another
            stream, 3 rejected; -1 if the learner has no states.
        typical: Median slowness of all features of the stream, with which the candidate is compared
            (progress learner only).
        regret: Recent improvement: logarithm of the slowness that an older candidate would have
            now, divided by that of the candidate (progress learner only).
    """

    iteration: int = _signal("k", show="hidden")
    t: int = _signal("t", unit="frames", show="hidden")
    log_time: int = _signal("", unit="ns", show="hidden")
    stream: int = _signal("s")
    module: int = _signal("i")
    novel: bool = _signal("")
    known_by: int = _signal("")
    saved: bool = _signal("")
    share: float = _signal("")
    novel_blocks: int = _signal("", unit="blocks", show="line")
    y: FloatArray = _signal("y", "TJ", equation="1")
    y_frozen: FloatArray = _signal("y_i", "MTJ", equation="1")
    eta: FloatArray = _signal("η", "J", "1/frame", equation="2")
    eta_dot: FloatArray = _signal("η̇", "J", "1/frame", equation="3")
    variance: FloatArray = _signal("v_r", "J")
    eta_inst: FloatArray = _signal("η^inst", "J", "1/frame", equation="4")
    gate_mean: FloatArray = _signal("m", "J", "1/frame")
    gate_sd: FloatArray = _signal("SD", "J", "1/frame")
    eta_inst_frozen: FloatArray = _signal("η_i^inst", "MJ", "1/frame", equation="4")
    band_mean: FloatArray = _signal("m_i", "MJ", "1/frame")
    band_sd: FloatArray = _signal("SD_i", "MJ", "1/frame")
    roc_error_inst: float = _signal("")
    roc_error: float = _signal("")
    roc_error_frozen: FloatArray = _signal("", "M")
    xi: float = _signal("⟨ξ⟩", equation="5")
    xi_dot: float = _signal("⟨ξ̇⟩", equation="5")
    curiosity: float = _signal("-⟨ξ̇⟩", equation="5")
    expert: float = _signal("βZ(⟨ξ⟩)", equation="5")
    reward: float = _signal("r", equation="5")
    R: FloatArray = _signal("R", "SAS", equation="6", show="heat")
    Q: FloatArray = _signal("Q", "SA", show="heat")
    policy: IntArray = _signal("π", "S")
    epsilon: float = _signal("ε")
    explored: bool = _signal("")
    action: int = _signal("a")
    next_stream: int = _signal("s'")
    change: float = _signal("c")
    tested: float = _signal("η_test", unit="1/frame")
    fitted: float = _signal("η_fit", unit="1/frame")
    learning_error: float = _signal("e")
    interest: FloatArray = _signal("", "S")
    state: IntArray = _signal("", "S")
    typical: float = _signal("η_typ", unit="1/frame")
    regret: float = _signal("")


# Number of streams above which the signal R is left out, because its size grows with their square.
DENSE_STREAMS = 64


# Description of each field, empty under python -OO. The indentation of a docstring depends on the
# version of Python; `getdoc` removes it.
_ABOUT = dict(re.findall(r"(?m)^    (\w+): (.+(?:\n {8}.+)*)", inspect.getdoc(BlockSignals) or ""))


def _described(field: dataclasses.Field[Any]) -> Signal:
    dtype = _DTYPES[str(field.type)]
    show = field.metadata["show"] or ("line" if dtype == "float64" else "lane")
    about = " ".join(_ABOUT.get(field.name, "").split())
    return Signal(name=field.name, dtype=dtype, about=about, **{**field.metadata, "show": show})


# The description of every signal, in the record's order.
SIGNALS: Mapping[str, Signal] = {f.name: _described(f) for f in dataclasses.fields(BlockSignals)}


class SignalsHash:
    """SHA-256 over the canonical bytes of all records in order.

    Canonical: for each field, its shape as little-endian int64, then its elements in C
    order as little-endian float64, int64 or one byte of a bool. Every NaN is the one that
    numpy calls `nan`: which of them an operation gives depends on the processor.
    """

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self.count = 0

    def add(self, signals: BlockSignals) -> None:
        """Add the next record to the hash."""
        self._hash.update(canonical_bytes(signals))
        self.count += 1

    def hexdigest(self) -> str:
        """Return the hash of all records so far."""
        return self._hash.hexdigest()


def canonical_bytes(signals: BlockSignals) -> bytes:
    """Return the bytes of a record with which runs are compared."""
    arrays: list[Any] = list(map(np.ascontiguousarray, _ARRAYS_OF(signals), _ARRAY_TYPES))
    layout = _layout(tuple([array.shape for array in arrays]))
    data = bytearray(b"".join([arrays[i] for i in layout.order]))
    floats = np.frombuffer(data, "<f8", layout.floats)
    floats[np.isnan(floats)] = math.nan
    numbers = [x if x == x else math.nan for x in _NUMBERS_OF(signals)]
    parts = [data[part] for part in layout.parts]
    return layout.struct.pack(*layout.placed([*numbers, *layout.sizes, *parts]))


_SCALARS = [s for s in SIGNALS.values() if not s.dims]
_ARRAYS = [s for s in SIGNALS.values() if s.dims]
_NUMBERS_OF = attrgetter(*(s.name for s in _SCALARS))
_ARRAYS_OF = attrgetter(*(s.name for s in _ARRAYS))
# Made from this text, the type is numpy's shared object, so that comparing types takes no time.
_ARRAY_TYPES = [np.dtype("<" + np.dtype(s.dtype).str[1:]) for s in _ARRAYS]


class _Layout(NamedTuple):
    """Layout of the canonical bytes of records whose arrays have the same shapes.

    Attributes:
        struct: format of all fields; an array is its shape and its elements.
        placed: sorts scalars, shapes and elements of the arrays into the order of the format.
        sizes: shape of each array as bytes.
        order: indices of the arrays, those of float64 first.
        floats: total number of elements of the float64 arrays.
        parts: slice of the elements of each array in the concatenation in that order.
    """

    struct: struct.Struct
    placed: Callable[[list[Any]], tuple[Any, ...]]
    sizes: list[bytes]
    order: list[int]
    floats: int
    parts: list[slice]


@lru_cache
def _layout(shapes: tuple[tuple[int, ...], ...]) -> _Layout:
    arrays, scalars = _ARRAYS, _SCALARS
    sizes = [struct.pack(f"<{len(shape)}q", *shape) for shape in shapes]
    lengths = [8 * math.prod(shape) for shape in shapes]
    order = sorted(range(len(arrays)), key=lambda i: arrays[i].dtype != "float64")
    starts = dict(zip(order, accumulate((lengths[i] for i in order), initial=0), strict=False))
    formats = ""
    places: list[int] = []
    for signal in SIGNALS.values():
        if signal.dims:
            i = arrays.index(signal)
            formats += f"{len(sizes[i])}s{lengths[i]}s"
            places += [len(scalars) + i, len(scalars) + len(arrays) + i]
        else:
            formats += {"float64": "d", "int64": "q", "bool": "?"}[signal.dtype]
            places.append(scalars.index(signal))
    floats = sum(n for n, s in zip(lengths, arrays, strict=True) if s.dtype == "float64") // 8
    parts = [slice(starts[i], starts[i] + n) for i, n in enumerate(lengths)]
    pack = struct.Struct("<" + formats)
    return _Layout(pack, itemgetter(*places), sizes, order, floats, parts)
