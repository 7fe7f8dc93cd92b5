"""Numeric kernels in C, compiled in advance, with Python functions that check their arguments.

C trusts its arguments: every function here checks the type, shape and order of its arrays and
passes pointers. The same arguments give the same bits with every compiler and on every x86-64 and
64-bit Arm processor, see `lanes.h`. The C files describe how each result is computed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, as_frames
from cdmisfa.core.blocks import UINT8
from cdmisfa.core.errors import CdmisfaError, UsageError

try:
    import cdmisfa.kernels._plain as _plain
except ImportError as error:
    raise CdmisfaError(
        f"{__path__[0]} has no compiled kernels: install cdmisfa with `make clean install` or pip; "
        "if it is installed elsewhere, run it outside of this folder"
    ) from error


FLOAT64, INT64 = np.dtype(np.float64), np.dtype(np.int64)
_POINTERS = {FLOAT64: "double[]", INT64: "int64_t[]", UINT8: "uint8_t[]"}

# Version of the order in which the kernels compute. Raise it with every change of their bits: runs
# of another version are then neither resumed nor verified.
ARITHMETIC = 3

# Both modules give the same bits; the second one needs a processor with AVX2 and FMA.
WIDE: bool = bool(_plain.lib.has_wide_lanes())
_module: Any = import_module("cdmisfa.kernels._wide") if WIDE else _plain
lib: Any = _module.lib
ffi: Any = _module.ffi
_buffer = ffi.from_buffer


def expect(name: str, actual: object, expected: object) -> None:
    """Check a property of an argument.

    Raises:
        UsageError: the property differs.
    """
    if actual != expected:
        raise UsageError(f"{name} is {actual}: give {expected}")


def expect_some(**sizes: int) -> None:
    """Check that sizes are at least 1.

    Raises:
        UsageError: one is not.
    """
    for name, size in sizes.items():
        if size < 1:
            raise UsageError(f"{name} is {size}: give at least 1")


def pointer(name: str, array: Any, shape: tuple[int, ...], dtype: np.dtype[Any] = FLOAT64) -> Any:
    """Return the address of an array for C to read and write; it keeps the array alive.

    Raises:
        UsageError: the array has another type or shape, is not in C order, or is read-only.
    """
    fits = type(array) is np.ndarray and array.dtype == dtype and array.shape == shape
    if not (fits and array.flags.carray):  # the texts take longer than small blocks, so only here
        actual: object = type(array)
        if actual is np.ndarray:
            actual = str(array.dtype), array.shape, "C" if array.flags.carray else "other order"
        expect(name, actual, (str(dtype), shape, "C"))
    return _buffer(_POINTERS[dtype], array, True)


def readable(name: str, array: Any, shape: tuple[int, ...], dtype: np.dtype[Any] = FLOAT64) -> Any:
    """Return the address of an array, or of a copy in C order, for C to read.

    Raises:
        UsageError: the array has another shape.
    """
    if type(array) is not np.ndarray or array.dtype != dtype or not array.flags.c_contiguous:
        array = np.array(array, dtype, order="C")
    if not array.flags.aligned:
        array = array.copy()
    expect(name, array.shape, shape)
    return _buffer(_POINTERS[dtype], array)


def records(kind: str, array: NDArray[np.void]) -> Any:
    """Return the address of an array of C records of a type.

    Raises:
        UsageError: the records of the array have another size.
    """
    expect(f"{kind} (bytes)", array.dtype.itemsize, ffi.sizeof(kind))
    return _buffer(f"{kind}[]", array, True)


class Struct:
    """C record that keeps its arrays alive.

    Attributes:
        pointer: pointer to the record.
        arrays: the addresses of its arrays.
    """

    __slots__ = ("arrays", "pointer")

    def __init__(self, kind: str, numbers: Mapping[str, float], arrays: Mapping[str, Any]) -> None:
        self.arrays = arrays
        self.pointer = ffi.new(f"{kind} *", {**numbers, **arrays})


def frames_of(frames: Any, size: int | None = None) -> Struct:
    """Return frames as C takes them; see `as_frames`."""
    rows = as_frames(frames, size)
    field = "pixels" if rows.dtype == UINT8 else "values"
    data = _buffer("uint8_t[]" if field == "pixels" else "double[]", rows)
    return Struct("frames", {"n": rows.shape[0], "size": rows.shape[1]}, {field: data})


def check(code: int, owner: str) -> None:
    """Raise the error of a kernel's return code.

    Raises:
        MemoryError: C could not allocate memory.
        UsageError: the state of `owner` was not written by a kernel.
    """
    if code == lib.NO_MEMORY:
        raise MemoryError
    if code == lib.NOT_A_STATE:
        raise UsageError(f"{owner} has a damaged state, an index is out of range: load another one")


def exp(x: float) -> float:
    """Return the exponential of a number."""
    return float(lib.exp_of(x))


def log(x: float) -> float:
    """Return the natural logarithm of a number."""
    return float(lib.log_of(x))


def sin(x: Any) -> FloatArray:
    """Return the sines of numbers with an absolute value of at most a million."""
    return _elementwise(lib.sines, x)


def cos(x: Any) -> FloatArray:
    """Return the cosines of numbers with an absolute value of at most a million."""
    return _elementwise(lib.cosines, x)


def _elementwise(function: Any, x: Any) -> FloatArray:
    shape = np.shape(x)
    out = np.empty(shape)
    function(readable("x", x, shape), out.size, pointer("out", out, shape))
    return out


def normal(rng: np.random.Generator, *shapes: tuple[int, ...]) -> list[FloatArray]:
    """Return arrays of standard normal draws; the generator cannot be used afterwards.

    The numbers equal those of `rng.standard_normal` up to rounding, which depends there on the C
    library of the machine.
    """
    sizes = [math.prod(shape) for shape in shapes]
    out = np.empty(sum(sizes))
    words = rng.bit_generator.random_raw(out.size + out.size // 16 + 64)
    into = _buffer("double[]", out), out.size
    while lib.normals(_buffer("uint64_t[]", words), words.size, *into) < 0:
        words = np.concatenate([words, rng.bit_generator.random_raw(words.size)])
    ends = np.cumsum(sizes)[:-1]
    return [part.reshape(s) for part, s in zip(np.split(out, ends), shapes, strict=True)]


def outputs(phi: FloatArray, offset: FloatArray, frames: Any) -> FloatArray:
    """Return y = phi x - offset of every row of phi on every frame; see `outputs.project`."""
    rows = len(phi)
    x = frames_of(frames, phi.shape[1])
    y = np.empty((x.pointer.n, rows))
    weights = readable("phi", phi, (rows, x.pointer.size)), readable("offset", offset, (rows,))
    check(lib.outputs(rows, *weights, x.pointer, _buffer("double[]", y)), "phi")
    return y


def mean_output(phi: FloatArray, mean: FloatArray) -> FloatArray:
    """Return (J,) the outputs of phi (J, I) on the mean input (I,)."""
    rows, size = phi.shape
    out = np.empty(rows)
    inputs = readable("phi", phi, phi.shape), readable("mean", mean, (size,))
    lib.mean_output(rows, size, *inputs, _buffer("double[]", out))
    return out


def incsfa(state: Any, nu: float, mean_window: float) -> Struct:
    """Return incremental SFA as C takes it: the arrays of `IncSFAState`, and its constants."""
    (K, size), J = state.v.shape, len(state.w)
    expect_some(inputs=size, components=K, outputs=J)
    shapes = {
        "mean": (size,),
        "v": (K, size),
        "d": (K,),
        "gram": (K, K),
        "w": (J, K),
        "z_prev": (K,),
        "phi": (J, size),
    }
    arrays = {name: pointer(name, getattr(state, name), shape) for name, shape in shapes.items()}
    arrays["counts"] = pointer("counts", state.counts, (3,), INT64)
    numbers = {"inputs": size, "components": K, "outputs": J, "nu": nu, "window": mean_window}
    return Struct("incsfa", numbers, arrays)


def incsfa_update(abstraction: Struct, frames: Any, gap: bool, by: str = "update") -> FloatArray:
    """Learn from consecutive frames; see `IncrementalFeature.update`.

    `by` is "by_frame" or "by_gram" for one of two ways to compute, which give different last bits;
    "update" chooses by the number of inputs.
    """
    x = frames_of(frames, abstraction.pointer.inputs)
    xi = np.empty(x.pointer.n)
    learn = getattr(lib, f"incsfa_{by}")
    code = learn(abstraction.pointer, x.pointer, bool(gap), _buffer("double[]", xi))
    check(code, "the abstraction")
    return xi


def instantaneous_slowness(y: Any) -> FloatArray:
    """Return (J,) the slowness of each output (n, J) within a block.

    Raises:
        UsageError: the block has no frames.
    """
    n, J = np.shape(y)
    expect_some(frames=n)
    eta = np.empty(J)
    lib.instantaneous_slowness(n, J, readable("y", y, (n, J)), _buffer("double[]", eta))
    return eta


def iterate(
    agent: Struct,
    frozen: Struct,
    feature: Struct,
    raw: Struct,
    x: Struct,
    t: int,
    uniforms: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Compute one iteration of the paper's agent; see `CuriousLearner.step`.

    Args:
        agent: the agent, changed in place together with the outcome that it points to.
        frozen: the saved modules.
        feature: the features being learned, which learn from the block if it is novel.
        raw: the block.
        x: the block, expanded.
        t: number of its first frame.
        uniforms: (3,) draws from [0, 1): whether to explore, which action, which stream.

    Returns:
        Outputs of the features (n, J), NaN if the block is not novel; outputs of the saved modules
        (M, n, J), their slowness (M, J) and their clustering error (M,).
    """
    n, J, M = agent.pointer.tau, agent.pointer.outputs, frozen.pointer.modules
    expect("frames", (raw.pointer.n, x.pointer.n), (n, n))
    _expect_inputs(agent, frozen, feature, x)
    results = np.empty((n, J)), np.empty((M, n, J)), np.empty((M, J)), np.empty(M)
    code = lib.iterate(
        *(agent.pointer, frozen.pointer, feature.pointer, raw.pointer, x.pointer),
        *(t, readable("uniforms", uniforms, (3,)), *(_buffer("double[]", r) for r in results)),
    )
    check(code, "the learner")
    return results


def iterations(
    agent: Struct,
    frozen: Struct,
    feature: Struct,
    raw: Struct,
    x: Struct,
    uniforms: FloatArray,
    swap_below: float,
    curves: Struct | None,
) -> int:
    """Iterate on periodic streams until an abstraction is ready; see `CuriousLearner.repeat`."""
    n, rows, streams = len(uniforms), raw.pointer.n, agent.pointer.streams
    enough = rows > streams * agent.pointer.tau
    expect("frames", (x.pointer.n, rows % streams, enough), (rows, 0, True))
    _expect_inputs(agent, frozen, feature, x)
    draws, record = readable("uniforms", uniforms, (n, 3)), curves.pointer if curves else ffi.NULL
    done: int = lib.iterations(
        *(agent.pointer, frozen.pointer, feature.pointer, raw.pointer, x.pointer),
        *(draws, n, swap_below, record),
    )
    check(done, "the learner")
    return done


def action_values(agent: Struct) -> FloatArray:
    """Return (S, 2) the values of both actions in every stream under the agent's policy."""
    Q = np.empty((agent.pointer.streams, 2))
    lib.action_values(agent.pointer, _buffer("double[]", Q))
    return Q


def _expect_inputs(agent: Struct, frozen: Struct, feature: Struct, x: Struct) -> None:
    sizes = feature.pointer.inputs, feature.pointer.outputs
    expect("the abstraction", sizes, (x.pointer.size, agent.pointer.outputs))
    expect("frozen modules", frozen.pointer.inputs, x.pointer.size)
    lengths = dict.fromkeys(("offset", "band_mean", "band_sd"), agent.pointer.outputs)
    lengths["phi"] = agent.pointer.outputs * x.pointer.size
    lengths |= {name: len(agent.arrays[name]) for name in ("centres", "counts")}
    for name, length in lengths.items():
        expect(f"frozen {name}", len(frozen.arrays[name]), frozen.pointer.modules * length)


def recursive_state(
    arrays: Mapping[str, NDArray[Any]], window: int, wide: int = 0, principal: int = 0
) -> Struct:
    """Return a state of recursive SFA as C takes it; see `RecursiveState`.

    The slow outputs after the first use `wide` components, if that is more than the spectrum has;
    the last `principal` outputs are principal components.
    """
    (size, inputs), outputs = arrays["basis"].shape, len(arrays["weights"])
    components = len(arrays["spectrum"])
    expect_some(inputs=inputs, size=size, components=components, outputs=outputs, window=window)
    expect("principal outputs fit", 0 <= principal < outputs, True)
    shapes = {
        "mean": (inputs,),
        "basis": (size, inputs),
        "variance": (size,),
        "differences": (size, size),
        "weights": (outputs, size),
        "spectrum": (components,),
        "last": (inputs,),
    }
    pointers = {name: pointer(name, arrays[name], shape) for name, shape in shapes.items()}
    pointers["counts"] = pointer("counts", arrays["counts"], (3,), INT64)
    sizes = {"inputs": inputs, "size": size, "components": components, "outputs": outputs}
    numbers = {**sizes, "window": window, "wide": wide, "principal": principal}
    return Struct("recursive", numbers, pointers)


def recursive_update(state: Struct, frames: Any, gap: bool) -> FloatArray:
    """Learn from consecutive frames; see `RecursiveFeature.update`."""
    x = frames_of(frames, state.pointer.inputs)
    change = np.empty(x.pointer.n)
    code = lib.recursive_update(state.pointer, x.pointer, bool(gap), _buffer("double[]", change))
    check(code, "the SFA")
    return change


def multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the product of a (n, k) and b (k, m), the same bits on every machine."""
    (rows, parts), width = a.shape, b.shape[1]
    first, second = readable("a", a, (rows, parts)), readable("b", b, (parts, width))
    out = np.empty((rows, width))
    c = _buffer("double[]", out)
    lib.multiply(rows, parts, width, first, parts, second, width, c, width)
    return out
