"""How images become frames: their size, and what is cropped, padded or stretched."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final, Self, get_args

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError, are_for
from recorder.images.compressed import compressed_image
from recorder.images.fields import bounded
from recorder.images.options import Centre, Depth, Fit, Size
from recorder.images.pixels import MalformedImage, Shown, raw_image, shrink

FRAME_PIXELS: Final = 48 * 128
"""Most pixels of a frame where no size is given: those of the paper's."""


@dataclass(frozen=True, slots=True)
class Framing:
    """How the images of one stream become frames.

    Attributes:
        first: size of its first image.
        size: of a frame.
        fit: see `fitted`.
        color: whether a frame shows red, green and blue beside one another.
    """

    first: Size
    size: Size
    fit: Fit
    color: bool = False

    def frame(self, image: ByteArray) -> ByteArray:
        """Make an image a frame; one of another size than the first may be smaller than a frame.

        Args:
            image: (height, width), or (height, width, 3) in colours.

        Raises:
            UsageError: the image is smaller, as the first is.
        """
        enlarge = size_of(image) != self.first
        if not self.color:
            return fitted(image, self.size, self.fit, enlarge=enlarge)
        planes = [image] if image.ndim == 2 else [image[:, :, c].copy() for c in range(3)]
        shown = [fitted(p, self.size, self.fit, enlarge=enlarge) for p in planes]
        return np.hstack(shown if len(shown) == 3 else shown * 3)

    def change(self, image: tuple[int, ...]) -> str:
        """A warning about an image of another shape; "" of one like the first."""
        size = image[0], image[1]
        if size == self.first:
            return ""
        before, now, frame = map(_in_words, (self.first, size, self.size))
        return f"images change from {before} to {now}; each is made a frame of {frame}"

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a frame."""
        return self.size[0], self.size[1] * (3 if self.color else 1)

    @property
    def lossy(self) -> str:
        """How images of another ratio are made to fit; see `cut_or_added`."""
        return cut_or_added(self.first, self.size, self.fit)

    def __str__(self) -> str:
        """How an image becomes a frame, in words."""
        shown = "" if self.first == self.size else f"shown as {_in_words(self.size)}"
        return ", ".join(filter(None, [_in_words(self.first), self.lossy, shown]))


@dataclass(frozen=True, slots=True)
class Vector:
    """How the numbers of one stream become frames: as they are.

    Attributes:
        count: how many there are in each message.
    """

    count: int
    lossy = ""

    def frame(self, numbers: Shown) -> Shown:
        """The numbers of a message, (count,) float64.

        Raises:
            UsageError: it holds others.
        """
        if numbers.shape != self.shape:
            least = min(self.count, len(numbers))
            raise UsageError(
                f"a message holds {len(numbers)} numbers, and the first {self.count}: choose a "
                f"part of the field, as --field position[0:{least}]"
            )
        return numbers

    def change(self, numbers: tuple[int, ...]) -> str:
        """Nothing: see `frame`."""
        return ""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a frame."""
        return (self.count,)

    def __str__(self) -> str:
        """What a frame is, in words."""
        return "a number" if self.count == 1 else f"{self.count} numbers"


def framings(
    firsts: Sequence[Shown], size: Size | None, fit: Fit, *, color: bool = False
) -> Sequence[Framing | Vector]:
    """How the images or numbers of streams become frames, all of one shape.

    Args:
        firsts: what each stream shows first.
        size: (height, width) of a frame; None for the `default_size` of the first image.
        fit: see `fitted`.
        color: show red, green and blue beside one another.

    Raises:
        UsageError: some show images and some numbers, or not as many.
    """
    if all(first.ndim > 1 for first in firsts):
        size = size or default_size(size_of(firsts[0]))
        return [Framing(size_of(first), size, fit, color) for first in firsts]
    counts = [len(first) for first in firsts if first.ndim == 1]
    if len(counts) < len(firsts) or len(set(counts)) > 1:
        raise UsageError(
            "streams that are learned from together show frames of one shape, and these show "
            + " and ".join(dict.fromkeys(_shown_in_words(first) for first in firsts))
            + ": take as many numbers of each, as with --field position[0:6], or each apart"
        )
    given = {"--size": size is not None, "input.fit": fit != "crop", "--color": color}
    if refused := [option for option, said in given.items() if said]:
        raise UsageError(f"numbers are taken as they are: {are_for(refused, 'images')}")
    return [Vector(count) for count in counts]


def size_of(image: Shown) -> Size:
    """The size of an image, (height, width)."""
    return image.shape[0], image.shape[1]


def default_size(image: Size) -> Size:
    """An image's size divided by the least whole number that leaves `FRAME_PIXELS` or fewer."""
    height, width = image
    divisor = 1
    while max(height // divisor, 1) * max(width // divisor, 1) > FRAME_PIXELS:
        divisor += 1
    return max(height // divisor, 1), max(width // divisor, 1)


def fitted(image: ByteArray, size: Size, fit: Fit, *, enlarge: bool = False) -> ByteArray:
    """Make an image a frame.

    Args:
        image: (height, width) uint8.
        size: of the frame.
        fit: where the ratio of the sides is another: "crop" cuts two sides, as much of each,
            "pad" puts black at them, "stretch" changes the ratio.
        enlarge: take a smaller image, too.

    Raises:
        UsageError: the image is smaller.
    """
    if image.shape == size:
        return image
    whole = image.shape
    if fit == "crop":
        image = _middle(image, _largest_within(size_of(image), size))
    if fit != "pad":
        return shrink(image, *size, enlarge=enlarge, whole=whole)
    inner = _largest_within(size, size_of(image))
    frame = np.zeros(size, np.uint8)
    _middle(frame, inner)[:] = shrink(image, *inner, enlarge=enlarge)
    return frame


def cut_or_added(image: Size, size: Size, fit: Fit) -> str:
    """How an image of another ratio was made to fit, in words; "" of one of the same ratio."""
    if fit == "crop":
        height, width = _largest_within(image, size)
        return "" if (height, width) == image else f"cropped to {width}x{height}"
    height, width = _largest_within(size, image)
    if (height, width) == size:
        return ""
    return f"padded from {width}x{height}" if fit == "pad" else "stretched"


def _shown_in_words(shown: Shown) -> str:
    return "images" if shown.ndim > 1 else str(Vector(len(shown)))


def _in_words(size: Size) -> str:
    return f"{size[1]}x{size[0]}"


def _largest_within(outer: Size, ratio: Size) -> Size:
    """The largest size within another that has the ratio of the sides of a third."""
    if outer[0] * ratio[1] > outer[1] * ratio[0]:
        return max(round(outer[1] * ratio[0] / ratio[1]), 1), outer[1]
    return outer[0], max(round(outer[0] * ratio[1] / ratio[0]), 1)


def _middle(image: ByteArray, size: Size) -> ByteArray:
    top, left = ((have - want) // 2 for have, want in zip(image.shape, size, strict=True))
    return image[top : top + size[0], left : left + size[1]]


_FORMATS = {("u1", 0): "mono8", ("u2", 0): "mono16", ("u1", 3): "rgb8", ("u1", 4): "rgba8"}
"""Pixel formats of arrays, by the type and the number of a pixel's values."""

_DISTANCES = {"u2": "16UC1", "f4": "32FC1", "f8": "32FC1"}

_PICTURES = (
    "give (n, height, width) of uint8 or uint16, (n, height, width, 3) or 4 of uint8, or these of "
    "bool, floats of 0 to 1, integers of 0 to 255, or a list of such pictures, or of the bytes of "
    "JPEG or PNG files"
)


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a raw picture, or numbers, become a frame.

    Attributes:
        shape: of a frame, (height, width) or (values,).
        fit: how a picture of another ratio of the sides becomes a frame: see `fitted`.
        color: whether a frame shows red, green and blue beside one another.
        range: distances in metres that are black and white, or what numbers are kept within.
        fields: the numbers that were taken, by the names that they had.
        pixels: the format of one colour a pixel that the source has, as bayer_rggb8; "" of others.
        raw: (height, width) of the source's pictures; empty where it did not say.
        centre: "episode" where frames lack the mean of their episode; see `centred`.
    """

    shape: tuple[int, ...]
    fit: Fit = "crop"
    color: bool = False
    range: Depth | None = None
    fields: tuple[str, ...] = ()
    pixels: str = ""
    raw: tuple[int, ...] = ()
    centre: Centre = "run"

    @classmethod
    def of(cls, described: Mapping[str, Any], shape: tuple[int, ...], stream: int = 0) -> Self:
        """The recipe of a source, from what it states of itself.

        Args:
            described: see `FrameSource.describe`.
            shape: of its frames.
            stream: whose numbers are meant.
        """
        bounds = described.get("range_metres") or described.get("range")
        named = described.get("fields") or []
        if named and isinstance(named[0], list):  # of each stream
            named = named[stream]
        return cls(
            tuple(shape),
            described.get("fit", "crop"),
            "color" in described,
            tuple(bounds) if bounds else None,
            tuple(named),
            centre=described.get("centre", "run"),
        )

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The recipe in a text of what `as_json` gives.

        Raises:
            ValueError: it is none.
        """
        values = json.loads(text)
        known = {field.name for field in fields(cls)}
        if not isinstance(values, dict) or not values.keys() >= {"shape"}:
            raise ValueError("a recipe has a shape")
        own: Any = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()
            if name in known
        }
        recipe = cls(**own)
        bounds = recipe.range or ()
        whole = (
            isinstance(recipe.shape, tuple)
            and isinstance(recipe.raw, tuple)
            and len(recipe.raw) in (0, 2)
            and all(type(side) is int and side > 0 for side in (*recipe.shape, *recipe.raw))
            and recipe.fit in get_args(Fit)
            and recipe.centre in get_args(Centre)
            and isinstance(recipe.color, bool)
            and (recipe.range is None or len(bounds) == 2)
            and all(isinstance(bound, int | float) for bound in bounds)
            and all(isinstance(name, str) for name in (*recipe.fields, recipe.pixels))
        )
        if not whole:
            raise ValueError("a recipe holds something else in its place")
        return recipe

    def as_json(self) -> dict[str, Any]:
        """The recipe as JSON values; without `centre` where it says nothing."""
        stated = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}
        if self.centre == "run":
            del stated["centre"]
        return stated

    @property
    def size(self) -> Size | None:
        """(height, width) of the picture that a frame shows; None of numbers."""
        if len(self.shape) != 2:
            return None
        return self.shape[0], self.shape[1] // (3 if self.color else 1)

    def refuse_turned(self, picture: Size) -> None:
        """Refuse an array's picture that is upright where the source's lay, or lies.

        Raises:
            UsageError: it is.
        """
        height, width = picture
        if self.raw and (height - width) * (self.raw[0] - self.raw[1]) < 0:
            raise UsageError(
                f"a picture of {width}x{height} given, and those learned from were of "
                f"{self.raw[1]}x{self.raw[0]}: turn it, as by np.swapaxes(x, 0, 1), or crop it"
            )

    def frames(self, pictures: Any) -> NDArray[Any]:
        """Raw pictures as frames; see `make_frame`. The mean of their episode stays in them.

        Args:
            pictures: an array with a first axis of n, or any iterable of n pictures.

        Returns:
            (n, *shape), uint8 of pictures and float64 of numbers.

        Raises:
            UsageError: these are no such pictures.
        """
        if self.size is None:
            return _numbers(pictures, self)
        single = isinstance(pictures, bytes) or not isinstance(pictures, Iterable)
        if single or (isinstance(pictures, np.ndarray) and pictures.ndim < 2):
            raise UsageError(f"one picture or none given: {_PICTURES}")
        made = [make_frame(picture, self) for picture in pictures]
        return np.stack(made) if made else np.empty((0, *self.shape), np.uint8)


def make_frame(picture: Any, recipe: Recipe) -> Shown:
    """The frame that a raw picture, or numbers, become: what a learner learns from.

    Colours become gray, as a source makes them, or stay beside one another, 16 bit count by their
    high byte, a Bayer pattern is taken apart, distances are shown from black to white; then the
    picture is cut, padded or stretched, and its areas are averaged.

    Args:
        picture: (height, width) uint8 or uint16, (height, width, 3) or 4 red, green, blue uint8,
            distances as uint16 in millimetres or floats in metres, or the bytes of a JPEG or PNG,
            which is turned as its EXIF says; of a recipe of numbers (values,) of any numbers.
        recipe: what is made of it.

    Returns:
        The frame, of `recipe.shape`: uint8, or float64 where it is numbers.

    Raises:
        UsageError: it is no such picture, smaller than a frame, or upright where the source's were
            not.
    """
    if recipe.size is None:
        row: Shown = _numbers([picture], recipe)[0]
        return row
    try:
        if isinstance(picture, bytes | bytearray | memoryview):
            image = compressed_image(bytes(picture), color=recipe.color)
        else:
            image = _image(np.asarray(picture), recipe)
    except MalformedImage as error:
        raise UsageError(f"a picture cannot be taken: {error}") from None
    size = image.shape[0], image.shape[1]
    if size[0] < recipe.size[0] or size[1] < recipe.size[1]:
        height, width = recipe.size
        raise UsageError(
            f"a picture of {size[1]}x{size[0]} is smaller than the frames that were learned from, "
            f"{width}x{height}: give larger ones"
        )
    return Framing(size, recipe.size, recipe.fit, recipe.color).frame(image)


def pixels_of(pictures: NDArray[Any]) -> NDArray[Any]:
    """Pictures as uint8 or uint16: truth as 0 and 255, floats of 0 to 1 as round(255 x).

    Whole numbers of 0 to 255 stay these, and others as they are.
    """
    if pictures.dtype == np.bool_:
        return np.where(pictures, np.uint8(255), np.uint8(0))
    most = {"f": 1, "i": 255, "u": 255}.get(pictures.dtype.kind, 0)
    plain = pictures.dtype in (np.uint8, np.uint16) or not pictures.size
    if plain or not most or not 0 <= pictures.min() <= pictures.max() <= most:
        return pictures
    if pictures.dtype.kind == "f":
        pictures = np.rint(pictures * pictures.dtype.type(255))
    return np.asarray(pictures, np.uint8)


def _image(array: NDArray[Any], recipe: Recipe) -> Shown:
    """A picture, gray (height, width), or (height, width, 3) in colours."""
    if recipe.range is None:
        array = pixels_of(array)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    kind, channels = array.dtype.str[1:], array.shape[2] if array.ndim == 3 else 0
    known = _FORMATS.get((kind, channels))
    if recipe.range is not None and not channels:
        known = _DISTANCES.get(kind, known)
    elif recipe.pixels and known in ("mono8", "mono16"):
        known = f"{recipe.pixels.rstrip('0123456789')}{known.removeprefix('mono')}"
    if known is None or array.ndim not in (2, 3):
        raise UsageError(f"pictures of {array.dtype} {array.shape} given: {_PICTURES}")
    height, width = array.shape[:2]
    recipe.refuse_turned((height, width))
    little = "<f4" if known == "32FC1" else f"<{kind}"
    data = np.ascontiguousarray(array, little).tobytes()
    return raw_image(data, height, width, known, depth=recipe.range, color=recipe.color)


def _numbers(rows: Any, recipe: Recipe) -> NDArray[np.float64]:
    """Rows of numbers as frames, (n, values)."""
    count = recipe.shape[0]
    try:
        numbers = np.asarray(rows)
    except ValueError:  # of several lengths
        numbers = np.asarray("")
    if numbers.ndim == 1 and recipe.shape == (1,):
        numbers = numbers[:, None]
    if numbers.shape[1:] != recipe.shape or numbers.dtype.kind not in "biuf":
        names = f" ({', '.join(recipe.fields)})" if recipe.fields else ""
        raise UsageError(
            f"{numbers.dtype} of shape {numbers.shape} given: give (n, {count}), rows of the "
            f"{count} numbers that were learned from{names}"
        )
    return bounded(numbers.astype(np.float64), recipe.range)
