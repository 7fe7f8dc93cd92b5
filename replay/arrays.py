"""Arrays of numbers and of pictures, of the caller's or in files of NumPy, as streams of frames."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import as_array
from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import UsageError, are_for
from recorder.images.framing import Framing, framings, pixels_of
from recorder.images.options import OF_EVERY_SOURCE, InputOptions
from recorder.images.pixels import Shown, raw_image
from replay.camera_logs.hue import CHOSEN, shows_hue
from replay.camera_logs.opening import fits_topic
from replay.storage.arrays import load_numbers
from replay.storage.identity import FilesIdentity, Identity, LoggedSource

ENDINGS: Final = (".npy", ".npz")
"""Endings of files of NumPy's arrays."""

FPS: Final = 50.0
"""Frames a second where nothing is said: arrays tell no times."""

TAKES: Final = ("size", "fit", "rate", "color", "topics")
"""The options of logs that arrays have a use for."""

RECIPE: Final = (
    "pictures: truth as 0 and 255, 16 bit by its high byte, floats of 0 to 1 as round(255 x); "
    "numbers as they are, float64"
)
"""How arrays of other types than uint8 become frames, for the record."""

_WANTED: Final = (
    "give (n,) or (n, values) numbers, or pictures as (n, height, width), or (n, height, width, 3) "
    "in colours"
)


class ArrayLog(LoggedSource):
    """Arrays as streams on one clock, the i-th rows together; it ends with the shortest.

    Args:
        streams: by its name, what each stream shows: numbers (n,) or (n, I) of any type, or
            pictures (n, height, width), or in colours (n, height, width, 3 or 4), of uint8,
            uint16, bool, or floats of 0 to 1; arrays, lists, or tables of pandas, Polars, Arrow
            or DuckDB.
        options: `TAKES` are heeded: pictures become frames as images of logs do.
        loop: begin again at the end.
        files: where they are from.

    Attributes:
        arrays: of each stream by its name, what it shows as it was given, frames first.
        framings: for each stream how a picture becomes a frame.
        color: whether frames show colours; see `shows_hue` of "auto".

    Raises:
        UsageError: they are no such arrays, or hold what is no finite number.
    """

    def __init__(
        self,
        streams: Mapping[str, Any],
        options: InputOptions | None = None,
        *,
        loop: bool = False,
        files: Sequence[Path] = (),
    ) -> None:
        options = options or InputOptions()
        _refuse_options(options)
        if options.color == "auto":
            colors = type(self)(streams, replace(options, color=True), loop=loop, files=files)
            options = replace(options, color=shows_hue(colors))
            self.notes = (CHOSEN[options.color is True],)
        if not streams:
            raise UsageError("no array given: name one at least")
        self._loop, self._files = loop, tuple(files)
        self.arrays = {str(name): _checked(str(name), given) for name, given in streams.items()}
        shown = list(self.arrays.values())
        firsts = [_pixels(array[:1])[0] for array in shown]
        _refuse_unlike(dict(zip(self.arrays, firsts, strict=True)))
        self.color = options.color is True
        self.framings = framings(firsts, options.size, options.fit, color=self.color)
        self._count = min(map(len, shown))
        self._about = {
            "size": list(self.framings[0].shape),
            "fit": options.fit,
            **({"color": "red, green and blue beside one another"} if self.color else {}),
            "recipe": RECIPE,
        }
        kind = "uint8" if isinstance(self.framings[0], Framing) else "float64"
        length, fps = None if loop else self._count, options.rate or FPS
        shape = self.framings[0].shape
        self._spec = SourceSpec(tuple(self.arrays), shape, kind, (), fps, START_NS, length)
        for stream in range(len(shown)):  # refused before anything is written
            self._block(stream, 0, 1)

    def _logs(self) -> Sequence[Identity]:
        return [FilesIdentity(path) for path in self._files]

    def _described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """The arrays by their SHA-256, or their files by that, and how they became frames."""
        return {
            "kind": "arrays",
            "files": list(logs),
            "streams": list(self.arrays) if self._files else self._hashes,
            **self._about,
            "rate": self._spec.fps,
            "frames": self._count,
            "loop": self._loop,
        }

    @cached_property
    def _hashes(self) -> list[dict[str, Any]]:
        found = []
        for name, array in self.arrays.items():
            digest = hashlib.sha256()
            for start in range(0, len(array), 1024):
                digest.update(np.ascontiguousarray(array[start : start + 1024]).data)
            about = {"dtype": array.dtype.str, "shape": list(array.shape)}
            found.append({"stream": name, **about, "sha256": digest.hexdigest()})
        return found

    def _block(self, stream: int, t: int, n: int) -> Block:
        array, framing = list(self.arrays.values())[stream], self.framings[stream]
        rows = array[(t + np.arange(n)) % self._count]
        if isinstance(framing, Framing):
            frames = np.stack([framing.frame(self._image(picture)) for picture in _pixels(rows)])
        else:
            frames = rows.astype(np.float64)
        return Block(stream, t, freeze(np.ascontiguousarray(frames)), freeze(np.empty((n, 0))))

    def _image(self, picture: Shown) -> Shown:
        """A picture in gray, or in colours where these are wanted."""
        if picture.ndim == 2 or self.color:
            return picture
        data = np.ascontiguousarray(picture).reshape(-1).data
        return raw_image(data, picture.shape[0], picture.shape[1], "rgb8")

    def _name(self) -> str:
        return str(self._files[0]) if self._files else f"the array {next(iter(self.arrays))}"


def are_arrays(paths: Sequence[Path]) -> bool:
    """Whether paths are files of NumPy's arrays.

    Raises:
        UsageError: some are, and some are others.
    """
    found = [path.suffix.lower() in ENDINGS for path in paths]
    if any(found) and not all(found):
        other = paths[found.index(False)]
        raise UsageError(f"{other} is no file of arrays as the others are: take each apart")
    return all(found) and bool(found)


def open_arrays(
    paths: Sequence[Path], options: InputOptions | None = None, *, loop: bool = False
) -> ArrayLog:
    """Open files of NumPy, .npy with a stream each or .npz with one an array.

    Args:
        paths: the files.
        options: see `ArrayLog`; `topics` name arrays of .npz files, all by default.
        loop: begin again at the end.

    Raises:
        UsageError: no such file or array, or as for `ArrayLog`.
        LogDamagedError: a file holds something else.
    """
    options = options or InputOptions()
    streams: dict[str, NDArray[Any]] = {}
    files = list(map(Path, map(str, paths)))
    for path in files:
        for name, array in load_numbers(path).items():
            streams[name if name not in streams else f"{path.stem}_{name}"] = array
    if options.topics:
        chosen = [n for t in options.topics for n in streams if fits_topic(n, t)]
        if len(set(chosen)) < len(options.topics):
            raise UsageError(f"{paths[0]}: it has the arrays {', '.join(streams)}: name of these")
        streams = {name: streams[name] for name in chosen}
    try:
        return ArrayLog(streams, options, loop=loop, files=files)
    except UsageError as error:
        raise type(error)(f"{', '.join(map(str, paths))}: {error}") from None


def _refuse_options(options: InputOptions) -> None:
    if of_logs := options.named(set(options.chosen()) - {*TAKES, *OF_EVERY_SOURCE}):
        raise UsageError(f"{are_for(of_logs, 'logs')}, and arrays tell neither times nor fields")


def _refuse_unlike(firsts: Mapping[str, Shown]) -> None:
    """Refuse streams of pictures beside numbers, or of other numbers of numbers."""
    said = {
        name: "pictures" if first.ndim > 1 else f"rows of {len(first)}"
        for name, first in firsts.items()
    }
    if len(set(said.values())) > 1:
        each = " and ".join(f"{name} {what}" for name, what in said.items())
        raise UsageError(f"streams that are learned from together show alike, and {each}")


def _checked(name: str, given: Any) -> NDArray[Any]:
    """What a stream shows as an array, (n, I) of numbers or (n, height, width[, 3])."""
    array = as_array(given, name)
    if array.dtype.kind not in "biuf":
        raise UsageError(f"{name}: its values are of type {array.dtype}, no numbers: {_WANTED}")
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim == 4 and array.shape[3] in (1, 3, 4):
        array = array[..., 0] if array.shape[3] == 1 else array[..., :3]
    elif array.ndim not in (2, 3):
        first = array.ndim == 4 and array.shape[1] in (1, 3, 4)
        move = ", so move its colours last, np.moveaxis(x, 1, -1)" if first else ""
        raise UsageError(f"{name}: it has shape {array.shape}{move}: {_WANTED}")
    if not array.size:
        raise UsageError(f"{name}: it is empty, of shape {array.shape}: give one frame at least")
    if array.dtype.kind == "f":
        finite = np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise UsageError(
                f"{name}: row {row}, counted from 0, holds what is no finite number (NaN or "
                f"infinity), as {int((~finite).sum())} of {len(array)} rows do: leave them out or "
                "fill them"
            )
    if array.ndim > 2 and array.dtype not in (np.uint8, np.uint16, np.bool_):
        low, high = array.min(), array.max()
        most = 1 if array.dtype.kind == "f" else 255
        if low < 0 or high > most:
            raise UsageError(
                f"{name}: pictures of {array.dtype} hold {low:g} to {high:g}: scale them to "
                f"0 to {most}, or give uint8; numbers that are no pictures are rows, "
                "as x.reshape(len(x), -1)"
            )
    return array


def _pixels(rows: NDArray[Any]) -> NDArray[Any]:
    """Rows as the streams of logs show them: pictures of uint8, or numbers."""
    if rows.ndim == 2:
        return rows.astype(np.float64)
    if rows.dtype == np.uint16:
        return (rows >> 8).astype(np.uint8)
    pixels: NDArray[Any] = pixels_of(rows).astype(np.uint8, copy=False)
    return pixels
