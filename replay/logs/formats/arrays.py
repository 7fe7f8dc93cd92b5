"""Arrays of numbers or images as streams: from the caller, or from NumPy files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, as_array
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import LogDamagedError, UsageError, one_line
from cdmisfa.core.untrusted import BUDGET, check_regular
from recorder.images.fields import EXACT, ROUNDED
from recorder.images.framing import pixels_of
from recorder.images.options import InputOptions
from recorder.images.pixels import ALPHA, HIGH_BYTE, losses, lost, raw_image
from replay.logs.formats.messages import NoTopicError, fits_topic
from replay.logs.stream import ChannelInfo, ExternalChannel, LogStream, Rows, picked
from replay.storage.arrays import NOT_ARRAYS

ENDINGS: Final = (".npy", ".npz")

# Default rate in frames per second, as arrays have no times.
FPS: Final = 50.0

# How arrays of other types than uint8 become frames. Runs store this text to identify their source,
# so that its wording does not change.
RECIPE: Final = (
    "pictures: truth as 0 and 255, 16 bit by its high byte, floats of 0 to 1 as round(255 x); "
    "numbers as they are, float64"
)

# Remedy in errors about an unsupported shape.
_FORMS: Final = (
    "use (n,) or (n, values) for numbers, (n, height, width) for gray images, or "
    "(n, height, width, 3) for images in color"
)


def streams(
    path: Path, options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> list[LogStream]:
    """Open a file of NumPy; each array of an .npz is a stream.

    Raises:
        UsageError: a chosen array does not exist or holds no frames.
        LogDamagedError: the file is damaged or holds no arrays.
    """
    arrays = load_numbers(path)
    chosen = [name for name in arrays if not options.topics or fits_topic(name, options.topics)]
    if not chosen:
        raise NoTopicError(f"{path}: no such array; choose from {', '.join(arrays)} with --topic")
    try:
        return array_streams({name: arrays[name] for name in chosen}, options, path)
    except UsageError as error:
        raise type(error)(f"{path}: {error}") from None


def array_streams(
    arrays: Mapping[str, Any], options: InputOptions, path: Path | None = None
) -> list[LogStream]:
    """Return arrays as streams.

    Args:
        arrays: by the stream's name numbers (n,) or (n, I) of any type, or images (n, height,
            width), or in colors (n, height, width, 3 or 4), of uint8, uint16, bool, or floats of
            0 to 1; arrays, lists, or tables of pandas, Polars, Arrow or DuckDB.
        options: whether colors are shown.
        path: path of their file; None for arrays of the caller.

    Raises:
        UsageError: an array has another shape, or holds numbers that are not finite.
    """
    if not arrays:
        raise UsageError("no array is given: give at least one")
    opened_streams = []
    for name, given in arrays.items():
        with losses() as lines:
            array = _checked(str(name), given)
        stream = LogStream(
            path=path or Path(f"the array {name}"),
            topic=str(name),
            count=len(array),
            begins=START_NS,
            read=partial(_frames, array, options.color is True),
            encoding="numpy",
            recipe=RECIPE,
            warnings=[f"{path}: {line}" if path else f"{name}: {line}" for line in lines],
            digest=None if path else partial(array_hash, str(name), array),
        )
        opened_streams.append(stream)
    return opened_streams


def load_numbers(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name; that of a .npy file is memory-mapped, named as the file.

    Raises:
        UsageError: the file does not exist, or is too large.
        LogDamagedError: the file is damaged or holds no arrays.
    """
    check_regular(path)
    try:
        if path.suffix.lower() == ".npy":
            return {path.stem: np.lib.format.open_memmap(path, mode="r")}
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            if sum(member.file_size for member in stored.zip.infolist()) > BUDGET:
                raise UsageError(f"{path}: the arrays exceed {BUDGET >> 20} MiB: save each as .npy")
            arrays = {name: stored[name] for name in stored.files}
    except NOT_ARRAYS as error:  # NumPy's own message advises allow_pickle=True, which is unsafe
        why = "it has Python objects or other data" if "pickle" in str(error) else one_line(error)
        raise LogDamagedError(f"{path} is not a file of NumPy arrays: {why}") from error
    if not arrays or not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise LogDamagedError(f"{path} is not a file of NumPy arrays: it has none")
    return arrays


def array_channels(path: Path) -> list[ExternalChannel]:
    """Return the arrays of a file; raises as `load_numbers`."""
    channels = []
    for name, array in load_numbers(path).items():
        shape = "x".join(map(str, array.shape[1:]))
        rows = len(array) if array.ndim else 1
        kind = f"{array.dtype} {shape}".rstrip()
        info = ChannelInfo(name, "numpy", kind, rows)
        channels.append(ExternalChannel(info, images=False))
    return channels


def array_hash(name: str, array: NDArray[Any]) -> dict[str, Any]:
    """Return name, type, shape and hash of an array of the caller, as JSON values."""
    digest = hashlib.sha256()
    for start in range(0, len(array), 1024):
        digest.update(np.ascontiguousarray(array[start : start + 1024]).data)
    about = {"dtype": array.dtype.str, "shape": list(array.shape)}
    return {"stream": name, **about, "sha256": digest.hexdigest()}


def _frames(array: NDArray[Any], color: bool, rows: Rows) -> tuple[NDArray[Any], FloatArray]:
    """Return rows of an array as images of uint8, or numbers of float64, never a view of it."""
    part, no_truth = picked(array, rows), np.empty((len(rows), 0))
    if part.ndim == 2:
        return part.astype(np.float64), no_truth
    lost("floats of 0 to 1 are reduced to 8 bits", part.dtype.kind == "f")
    is_words = part.dtype == np.uint16
    lost(HIGH_BYTE, is_words)
    pixels = (part >> 8 if is_words else pixels_of(part)).astype(np.uint8)
    if pixels.ndim == 3 or color:
        return pixels, no_truth
    height, width = pixels.shape[1:3]
    gray = [
        raw_image(np.ascontiguousarray(x).reshape(-1).data, height, width, "rgb8") for x in pixels
    ]
    return np.stack(gray), no_truth


def _checked(name: str, given: Any) -> NDArray[Any]:
    """Return an array as (n, I) of numbers or (n, height, width[, 3])."""
    array = as_array(given, name)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim == 4 and array.shape[3] in (1, 4):
        lost(ALPHA, array.shape[3] == 4)
        array = array[..., 0] if array.shape[3] == 1 else array[..., :3]
    images = array.ndim == 3 or (array.ndim == 4 and array.shape[3] == 3)
    if array.dtype.kind not in "biuf" or not (images or array.ndim == 2) or not array.size:
        hint = "; np.moveaxis(x, 1, -1) moves the colors to the end" if array.ndim == 4 else ""
        raise UsageError(
            f"{name}: shape {array.shape} of {array.dtype} is not supported: {_FORMS}{hint}"
        )
    high = 1 if array.dtype.kind == "f" else 255
    finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if not finite.all():
        row, count = int(np.argmin(finite)), int((~finite).sum())
        raise UsageError(
            f"{name}: {count} of {len(array)} rows have NaN or infinity, the first is row {row} "
            "(from 0): remove them"
        )
    exact = array.ndim > 2 or array.dtype.itemsize < 8 or array.dtype.kind == "f"
    lost(ROUNDED, not exact and (array.max() >= EXACT or array.min() <= -EXACT))
    scaled = array.dtype in (np.uint8, np.uint16, np.bool_)
    if images and not scaled and not 0 <= array.min() <= array.max() <= high:
        raise UsageError(
            f"{name}: images of {array.dtype} range from {array.min():g} to {array.max():g}: scale "
            f"them to 0 to {high}, or give rows of numbers as x.reshape(len(x), -1)"
        )
    return array.astype(array.dtype.newbyteorder("="), copy=False)
