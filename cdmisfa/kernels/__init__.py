"""The kernels: C, compiled ahead of time, behind one boundary.

Every function checks the type, shape and order of its arrays and passes pointers on; C trusts them.
The same arguments give the same bits with every compiler and on every x86-64 and 64-bit Arm
processor: see `lanes.h`. The C files say how each result is computed.
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
        f"{__path__[0]} holds no compiled kernels: install cdmisfa with make clean install or "
        "pip, and run it in another folder than its sources where these are not what is installed"
    ) from error


FLOAT64, INT64 = np.dtype(np.float64), np.dtype(np.int64)
_POINTERS = {FLOAT64: "double[]", INT64: "int64_t[]", UINT8: "uint8_t[]"}

# Version of the order in which the kernels compute, to be raised with every change of their bits:
# runs of another version are neither continued nor checked.
ARITHMETIC = 3

# The same bits come from both modules; the second is for processors with AVX2 and FMA.
WIDE: bool = bool(_plain.lib.has_wide_lanes())
_module: Any = import_module("cdmisfa.kernels._wide") if WIDE else _plain
lib: Any = _module.lib
ffi: Any = _module.ffi
_buffer = ffi.from_buffer


def expect(name: str, given: object, wanted: object) -> None:
    """Refuse an argument that C could not use.

    Raises:
        UsageError: the argument differs.
    """
    if given != wanted:
        raise UsageError(f"{name} given as {given}: give {wanted}")


def pointer(name: str, array: Any, shape: tuple[int, ...], dtype: np.dtype[Any] = FLOAT64) -> Any:
    """Return the address of an array for C to read and write; it keeps the array alive.

    Raises:
        UsageError: it is of another type or shape, does not lie in C order, or is read-only.
    """
    fits = type(array) is np.ndarray and array.dtype == dtype and array.shape == shape
    if not (fits and array.flags.carray):  # names of types take longer than small blocks
        given: object = type(array)
        if given is np.ndarray:
            given = str(array.dtype), array.shape, "C" if array.flags.carray else "other order"
        expect(name, given, (str(dtype), shape, "C"))
    return _buffer(_POINTERS[dtype], array, True)


def readable(name: str, array: Any, shape: tuple[int, ...], dtype: np.dtype[Any] = FLOAT64) -> Any:
    """Return the address of an array, or of a copy in C order, for C to read.

    Raises:
        UsageError: it is of another shape.
    """
    if type(array) is not np.ndarray or array.dtype != dtype or not array.flags.c_contiguous:
        array = np.array(array, dtype, order="C")
    if not array.flags.aligned:
        array = array.copy()
    expect(name, array.shape, shape)
    return _buffer(_POINTERS[dtype], array)


def records(kind: str, array: NDArray[np.void]) -> Any:
    """Return the address of an array of records, which C has by that name."""
    return _buffer(f"{kind}[]", array, True)


class Struct:
    """A record of C whose arrays live as long as it does.

    Attributes:
        pointer: to the record.
    """

    __slots__ = ("_kept", "pointer")

    def __init__(self, kind: str, numbers: Mapping[str, float], arrays: Mapping[str, Any]) -> None:
        self._kept = arrays
        self.pointer = ffi.new(f"{kind} *", {**numbers, **arrays})


def frames_of(frames: Any, size: int | None = None) -> Struct:
    """Return frames as C takes them; see `as_frames`."""
    rows = as_frames(frames, size)
    held = "pixels" if rows.dtype == UINT8 else "values"
    data = _buffer("uint8_t[]" if held == "pixels" else "double[]", rows)
    return Struct("frames", {"n": rows.shape[0], "size": rows.shape[1]}, {held: data})


def check(code: int, what: str) -> None:
    """Raise the error of a kernel's return code.

    Raises:
        MemoryError: there was not enough.
        UsageError: `what` is no state that a kernel left.
    """
    if code == lib.NO_MEMORY:
        raise MemoryError
    if code == lib.NOT_A_STATE:
        raise UsageError(f"{what} holds an index that points nowhere: it is not a state of one")


def exp(x: float) -> float:
    """Exp of a number."""
    return float(lib.exp_of(x))


def log(x: float) -> float:
    """Natural logarithm of a number."""
    return float(lib.log_of(x))


def sin(x: Any) -> FloatArray:
    """Sines of an array of numbers up to a million."""
    return _of_each(lib.sines, x)


def cos(x: Any) -> FloatArray:
    """Cosines of the same."""
    return _of_each(lib.cosines, x)


def _of_each(function: Any, x: Any) -> FloatArray:
    shape = np.shape(x)
    out = np.empty(shape)
    function(readable("x", x, shape), out.size, pointer("out", out, shape))
    return out


def normal(rng: np.random.Generator, *shapes: tuple[int, ...]) -> list[FloatArray]:
    """Standard normal draws of a generator, which is of no use afterwards, as arrays of shapes.

    They are what `rng.standard_normal` gives one after the other, but for its rounding, which
    depends on the C library.
    """
    sizes = [math.prod(shape) for shape in shapes]
    out = np.empty(sum(sizes))
    words = rng.bit_generator.random_raw(out.size + out.size // 16 + 64)
    while (
        lib.normals(_buffer("uint64_t[]", words), words.size, _buffer("double[]", out), out.size)
        < 0
    ):
        words = np.concatenate([words, rng.bit_generator.random_raw(words.size)])
    ends = np.cumsum(sizes)[:-1]
    return [part.reshape(s) for part, s in zip(np.split(out, ends), shapes, strict=True)]


def outputs(phi: FloatArray, offset: FloatArray, frames: Any) -> FloatArray:
    """Output y = phi x - offset of every row of phi on every frame; see `projection.project`."""
    rows = len(phi)
    x = frames_of(frames, phi.shape[1])
    y = np.empty((x.pointer.n, rows))
    code = lib.outputs(
        rows,
        readable("phi", phi, (rows, x.pointer.size)),
        readable("offset", offset, (rows,)),
        x.pointer,
        _buffer("double[]", y),
    )
    check(code, "phi")
    return y


def mean_output(phi: FloatArray, mean: FloatArray) -> FloatArray:
    """Return what phi (J, I) gives out on the mean input (I,), as (J,)."""
    rows, size = phi.shape
    out = np.empty(rows)
    lib.mean_output(
        rows,
        size,
        readable("phi", phi, phi.shape),
        readable("mean", mean, (size,)),
        _buffer("double[]", out),
    )
    return out


def incsfa(state: Any, nu: float, mean_window: float) -> Struct:
    """Return an abstraction as the kernels take it: the arrays of its `State`, its constants."""
    (K, size), J = state.v.shape, len(state.w)
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

    What is faster is chosen by the number of inputs; `by` is "by_frame" or "by_gram" to say which.
    """
    x = frames_of(frames, abstraction.pointer.inputs)
    xi = np.empty(x.pointer.n)
    learn = getattr(lib, f"incsfa_{by}")
    code = learn(abstraction.pointer, x.pointer, bool(gap), _buffer("double[]", xi))
    check(code, "the abstraction")
    return xi


def instantaneous_slowness(y: Any) -> FloatArray:
    """Slowness of each output within a block, (J,), from its values (n, J)."""
    n, J = np.shape(y)
    eta = np.empty(J)
    lib.instantaneous_slowness(n, J, readable("y", y, (n, J)), _buffer("double[]", eta))
    return eta


def iterate(
    agent: Struct,
    frozen: Struct,
    feature: Struct,
    shown: Struct,
    x: Struct,
    t: int,
    uniforms: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Compute one iteration of a curious agent with an abstraction; see `CuriousLearner.step`.

    Args:
        agent: changed in place, as is the outcome that it points to.
        frozen: the frozen modules.
        feature: learns from the block where it is novel.
        shown: the block.
        x: the same, expanded.
        t: its first frame.
        uniforms: (3,) draws from [0, 1): whether to explore, which action, which stream.

    Returns:
        Outputs (n, J), NaN where the block is not novel; those of the frozen modules (M, n, J),
        their slowness (M, J) and clustering error (M,).
    """
    n, J, M = agent.pointer.tau, agent.pointer.outputs, frozen.pointer.modules
    expect("frames", (shown.pointer.n, x.pointer.n), (n, n))
    _expect_inputs(agent, frozen, feature, x)
    results = np.empty((n, J)), np.empty((M, n, J)), np.empty((M, J)), np.empty(M)
    code = lib.iterate(
        *(agent.pointer, frozen.pointer, feature.pointer, shown.pointer, x.pointer),
        *(t, readable("uniforms", uniforms, (3,)), *(_buffer("double[]", r) for r in results)),
    )
    check(code, "the learner")
    return results


def iterations(
    agent: Struct,
    frozen: Struct,
    feature: Struct,
    shown: Struct,
    x: Struct,
    uniforms: FloatArray,
    swap_below: float,
    kept: Struct | None,
) -> int:
    """Iterate on streams that repeat until something is to be done; see `CuriousLearner.repeat`."""
    n, rows, streams = len(uniforms), shown.pointer.n, agent.pointer.streams
    enough = rows > streams * agent.pointer.tau
    expect("frames", (x.pointer.n, rows % streams, enough), (rows, 0, True))
    _expect_inputs(agent, frozen, feature, x)
    draws, curves = readable("uniforms", uniforms, (n, 3)), kept.pointer if kept else ffi.NULL
    done: int = lib.iterations(
        *(agent.pointer, frozen.pointer, feature.pointer, shown.pointer, x.pointer),
        *(draws, n, swap_below, curves),
    )
    check(done, "the learner")
    return done


def action_values(agent: Struct) -> FloatArray:
    """Return the values of both actions in every stream under the agent's policy, (S, 2)."""
    Q = np.empty((agent.pointer.streams, 2))
    lib.action_values(agent.pointer, _buffer("double[]", Q))
    return Q


def _expect_inputs(agent: Struct, frozen: Struct, feature: Struct, x: Struct) -> None:
    sizes = feature.pointer.inputs, feature.pointer.outputs
    expect("the abstraction", sizes, (x.pointer.size, agent.pointer.outputs))
    expect("frozen modules", frozen.pointer.inputs, x.pointer.size)


def recursive_state(arrays: Mapping[str, NDArray[Any]], window: int) -> Struct:
    """Return a state of recursive SFA as C takes it, to be written to; see `recursive.State`."""
    (size, inputs), outputs = arrays["basis"].shape, len(arrays["weights"])
    components = len(arrays["spectrum"])
    shapes = {
        "mean": (inputs,),
        "basis": (size, inputs),
        "variance": (size,),
        "differences": (size, size),
        "weights": (outputs, size),
        "spectrum": (components,),
        "last": (inputs,),
    }
    held = {name: pointer(name, arrays[name], shape) for name, shape in shapes.items()}
    held["counts"] = pointer("counts", arrays["counts"], (3,), INT64)
    sizes = {"inputs": inputs, "size": size, "components": components, "outputs": outputs}
    return Struct("recursive", {**sizes, "window": window}, held)


def recursive_update(state: Struct, frames: Any, gap: bool) -> FloatArray:
    """Learn from consecutive frames; see `RecursiveFeature.update`."""
    x = frames_of(frames, state.pointer.inputs)
    change = np.empty(x.pointer.n)
    code = lib.recursive_update(state.pointer, x.pointer, bool(gap), _buffer("double[]", change))
    check(code, "the SFA")
    return change


def multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a (n, k) times B (k, m)."""
    (rows, parts), width = a.shape, b.shape[1]
    first, second = readable("a", a, (rows, parts)), readable("b", b, (parts, width))
    out = np.empty((rows, width))
    c = _buffer("double[]", out)
    lib.multiply(rows, parts, width, first, parts, second, width, c, width)
    return out
