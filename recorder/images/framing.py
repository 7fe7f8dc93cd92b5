"""How images and numbers become frames: size, crop, padding, colors.

A `Framing` serves the images of a log or a camera; a `Recipe` repeats it for a user's raw images.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.blocks import FrameKind
from cdmisfa.core.config import Section, key
from cdmisfa.core.errors import UsageError, are_for
from cdmisfa.core.names import counted
from recorder.images.compressed import compressed_image
from recorder.images.fields import EXACT, ROUNDED, bounded
from recorder.images.options import Centre, Depth, Fit, Size
from recorder.images.pixels import Content, MalformedImage, raw_image, shrink

# Largest number of pixels of a frame if no size is given, that of the paper's frames.
FRAME_PIXELS: Final = 48 * 128


@dataclass(frozen=True, slots=True)
class Framing:
    """How the images, or the numbers, of one stream become frames.

    Attributes:
        first: size of the stream's first image; () for numbers, which are not changed.
        size: (height, width) of a frame; (count,) for numbers.
        fit: how images of another aspect ratio become frames, see `fitted`.
        color: True if a frame shows the red, green and blue images side by side.
        native: True for frames (height, width, 3), or (height, width, 1) without `color`.
    """

    first: tuple[int, ...]
    size: tuple[int, ...]
    fit: Fit = "crop"
    color: bool = False
    native: bool = False

    def frame(self, image: Content) -> Content:
        """Convert an image, (height, width[, 3]), or the numbers of a message to a frame.

        Raises:
            UsageError: the image is as small as the first one, and smaller than a frame (an image
                that is smaller than the first one is enlarged); or the number of values changed.
        """
        if not self.first:
            if image.shape != self.size:
                least = min(self.size[0], len(image))
                raise UsageError(
                    f"a message has {len(image)} numbers, but the first had {self.size[0]}: choose "
                    f"a part of the field, such as --field position[0:{least}]"
                )
            return image
        if self.native and (image.ndim == 3) != self.color:
            raise UsageError("its images change between gray and color: use --color off")
        if self.native and size_of(image) == self.size:
            return image.reshape(self.shape)
        height, width = self.size
        enlarge = size_of(image) != self.first
        planes = [image] if image.ndim == 2 else [image[:, :, c].copy() for c in range(3)]
        frames = [fitted(p, (height, width), self.fit, enlarge=enlarge) for p in planes]
        if self.native:
            return np.dstack(frames)
        if not self.color:
            return frames[0]
        return np.hstack(frames if len(frames) == 3 else frames * 3)

    def change(self, image: Content) -> str:
        """Return a warning about an image of another size, or about rounded numbers, or ""."""
        if not self.first:
            return ROUNDED if len(image) and np.abs(image).max() >= EXACT else ""
        size = size_of(image)
        if size == self.first:
            return ""
        before, now, frame = map(_size_text, (self.first, size, self.size))
        return f"images change from {before} to {now}: each is resized to {frame}"

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame."""
        channels = 3 if self.color else 1
        wide = (*self.size[:-1], self.size[-1] * channels)
        return (*self.size, channels) if self.native else wide

    @property
    def kind(self) -> FrameKind:
        """Shape and type of a frame."""
        return self.shape, "uint8" if self.first else "float64"

    @property
    def lossy(self) -> str:
        """Description of how images of another aspect ratio are fitted; "" for the same ratio."""
        if not self.first:
            return ""
        if self.fit == "crop":
            inner = _largest_within(self.first, self.size)
            return "" if inner == self.first else f"cropped to {_size_text(inner)}"
        inner = _largest_within(self.size, self.first)
        if inner == self.size:
            return ""
        return f"padded from {_size_text(inner)}" if self.fit == "pad" else "stretched"

    def __str__(self) -> str:
        """Return a description of how an image becomes a frame."""
        if not self.first:
            return counted(self.size[0], "number")
        resized = "" if self.first == self.size else f"resized to {_size_text(self.size)}"
        return ", ".join(filter(None, [_size_text(self.first), self.lossy, resized]))


def framings(
    firsts: Sequence[Content], size: Size | None, fit: Fit, *, color: bool, native: bool = False
) -> Sequence[Framing]:
    """Choose how images become frames of one shape, and numbers frames as they are.

    Args:
        firsts: first image or numbers of each stream.
        size: (height, width) of a frame; None: the `default_size` for the first image.
        fit: see `fitted`.
        color: True to show the red, green and blue images side by side.
        native: True to keep size and colors of the images.

    Raises:
        UsageError: an option for images is set, and no stream has images.
    """
    images = [first for first in firsts if first.ndim > 1]
    in_color = color and not native
    image_options = {"--size": size is not None, "input.fit": fit != "crop", "--color": in_color}
    refused = [option for option, chosen in image_options.items() if chosen]
    if refused and not images:
        raise UsageError(f"the frames are numbers: {are_for(refused, 'images')}")
    common = size or (default_size(size_of(images[0])) if images else (0, 0))
    return [
        Framing((), first.shape)
        if first.ndim < 2
        else Framing(size_of(first), size or size_of(first), fit, first.ndim == 3, native=True)
        if native
        else Framing(size_of(first), common, fit, color)
        for first in firsts
    ]


def size_of(image: Content) -> Size:
    """Return the size of an image, (height, width)."""
    return image.shape[0], image.shape[1]


def default_size(image: Size) -> Size:
    """Return a size divided by the smallest whole number that leaves at most `FRAME_PIXELS`."""
    height, width = image
    divisor = 1
    while max(height // divisor, 1) * max(width // divisor, 1) > FRAME_PIXELS:
        divisor += 1
    return max(height // divisor, 1), max(width // divisor, 1)


def fitted(image: ByteArray, size: Size, fit: Fit, *, enlarge: bool = False) -> ByteArray:
    """Convert a gray image to a frame.

    Args:
        image: (height, width) uint8.
        size: (height, width) of the frame.
        fit: for another aspect ratio: "crop" cuts two opposite sides equally, "pad" adds black
            borders, "stretch" changes the ratio.
        enlarge: True to accept an image that is smaller than the frame.

    Raises:
        UsageError: the image is smaller than the frame.
    """
    if image.shape == size:
        return image
    whole = size_of(image)
    if fit == "crop":
        image = _middle(image, _largest_within(whole, size))
    inner = _largest_within(size, whole) if fit == "pad" else size
    if not enlarge and (image.shape[0] < inner[0] or image.shape[1] < inner[1]):
        raise UsageError(
            f"an image of {_size_text(whole)} is smaller than {_size_text(size)}: use larger "
            "images, or learn from smaller frames with --size"
        )
    if inner == size:
        return shrink(image, *size)
    frame = np.zeros(size, np.uint8)
    _middle(frame, inner)[:] = shrink(image, *inner)
    return frame


def _size_text(size: Sequence[int]) -> str:
    return f"{size[1]}x{size[0]}"


def _largest_within(outer: Sequence[int], ratio: Sequence[int]) -> Size:
    """Return the largest size within `outer` with the aspect ratio of `ratio`."""
    if outer[0] * ratio[1] > outer[1] * ratio[0]:
        return max(round(outer[1] * ratio[0] / ratio[1]), 1), outer[1]
    return outer[0], max(round(outer[0] * ratio[1] / ratio[0]), 1)


def _middle(image: ByteArray, size: Size) -> ByteArray:
    top, left = ((have - want) // 2 for have, want in zip(image.shape, size, strict=True))
    return image[top : top + size[0], left : left + size[1]]


# Pixel formats of arrays, by element type and number of channels (0: gray).
_FORMATS = {("u1", 0): "mono8", ("u2", 0): "mono16", ("u1", 3): "rgb8", ("u1", 4): "rgba8"}

_DISTANCES = {"u2": "16UC1", "f4": "32FC1", "f8": "32FC1"}

_IMAGES = "give uint8 of (n, height, width) or (n, height, width, 3), or floats of 0 to 1"


@dataclass(frozen=True, slots=True)
class Recipe(Section):
    """How a raw image or numbers become a frame; each module has the recipe of its stream.

    Attributes:
        shape: shape of a frame, (height, width) or (values,).
        fit: "crop", "pad" or "stretch" images of another aspect ratio.
        color: whether a frame shows red, green and blue side by side.
        range: distances in metres that are shown black and white, or limits of the numbers.
        fields: names of the numbers.
        pixels: Bayer format of the source, such as "bayer_rggb8", or "".
        raw: (height, width) of the images of the source; empty if unknown.
        centre: "episode" if the mean of its episode is subtracted from each frame.
    """

    prefix: ClassVar[str] = "recipe"
    shape: tuple[int, ...] = key((), 1)
    fit: Fit = "crop"
    color: bool = False
    range: Depth | None = None
    fields: tuple[str, ...] = ()
    pixels: str = ""
    raw: tuple[int, ...] = key((), 1)
    centre: Centre = "run"

    @classmethod
    def of(cls, described: Mapping[str, Any], shape: tuple[int, ...], stream: int = 0) -> Self:
        """Return the recipe that the description of a source states.

        Args:
            described: description, see `FrameSource.describe`.
            shape: shape of the frames.
            stream: index of the stream, if frames are numbers.
        """
        bounds = described.get("range_metres") or described.get("range")
        names = described.get("fields") or []
        if names and isinstance(names[0], list):  # a list for each stream
            names = names[stream]
        return cls(
            tuple(shape),
            described.get("fit", "crop"),
            "color" in described,
            tuple(bounds) if bounds else None,
            tuple(names),
            centre=described.get("centre", "run"),
        )

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the recipe that `as_json` returned.

        Raises:
            ValueError: the text is not a recipe.
        """
        values, names = json.loads(text), {field.name for field in fields(cls)}
        try:
            recipe = cls(**{name: value for name, value in values.items() if name in names})
        except (UsageError, AttributeError, TypeError) as error:
            raise ValueError(f"it is not a recipe: {error}") from None
        if not recipe.shape or len(recipe.raw) not in (0, 2):
            raise ValueError("it is not a recipe: its shape or the size of raw images is missing")
        return recipe

    def as_json(self) -> dict[str, Any]:
        """Return the recipe as JSON values, without `centre` if it is the default."""
        stated = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}
        if self.centre == "run":
            del stated["centre"]
        return stated

    @property
    def size(self) -> Size | None:
        """(height, width) of the image that a frame shows; None for numbers."""
        if len(self.shape) != 2:
            return None
        return self.shape[0], self.shape[1] // (3 if self.color else 1)

    def frames(self, images: Any) -> NDArray[Any]:
        """Turn an iterable of n raw images into frames, (n, *shape); see `make_frame`.

        The mean of their episode is not subtracted.
        """
        if self.size is None:
            return _numbers(images, self)
        iterable = images if isinstance(images, Iterable) else [images]
        frames = [make_frame(image, self) for image in iterable]
        return np.stack(frames) if frames else np.empty((0, *self.shape), np.uint8)


def make_frame(image: Any, recipe: Recipe) -> Content:
    """Turn a raw image or numbers into a frame as the module saw it in learning.

    Colors become gray or are put side by side, 16-bit pixels are reduced to their high byte, a
    Bayer pattern is decoded, and distances become gray levels. Then the image is cropped, padded
    or stretched, and reduced by averaging areas.

    Args:
        image: (height, width) of uint8 or uint16; (height, width, 3) or 4 of uint8: red, green,
            blue; distances as uint16 in millimetres or floats in metres; or the bytes of a JPEG or
            PNG file, which is rotated as its EXIF states. For a recipe of numbers: (values,).
        recipe: recipe of the module.

    Returns:
        The frame, of shape `recipe.shape`, uint8; float64 for numbers.

    Raises:
        UsageError: the image has another type, is smaller than a frame, or is upright although the
            images of the source were not.
    """
    if recipe.size is None:
        return np.asarray(_numbers([image], recipe)[0])
    try:
        if isinstance(image, bytes | bytearray | memoryview):
            pixels = compressed_image(bytes(image), color=recipe.color)
        else:
            pixels = _image(np.asarray(image), recipe)
    except MalformedImage as error:
        raise UsageError(f"an image cannot be read: {error}") from None
    return Framing(size_of(pixels), recipe.size, recipe.fit, recipe.color).frame(pixels)


def pixels_of(images: NDArray[Any]) -> NDArray[Any]:
    """Convert images to uint8 or uint16: booleans to 0 and 255, floats of 0 to 1 by round(255 x).

    Whole numbers of 0 to 255 keep their values; other images are returned unchanged.
    """
    if images.dtype == np.bool_:
        return np.where(images, np.uint8(255), np.uint8(0))
    limit = {"f": 1, "i": 255, "u": 255}.get(images.dtype.kind, 0)
    plain = images.dtype in (np.uint8, np.uint16) or not images.size
    if plain or not limit or not 0 <= images.min() <= images.max() <= limit:
        return images
    if images.dtype.kind == "f":
        images = np.rint(images * images.dtype.type(255))
    return np.asarray(images, np.uint8)


def _image(array: NDArray[Any], recipe: Recipe) -> Content:
    """Return the image of an array, gray (height, width) or color (height, width, 3)."""
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
        raise UsageError(f"images are {array.dtype} {array.shape}: {_IMAGES}")
    height, width = array.shape[:2]
    if recipe.raw and (height - width) * (recipe.raw[0] - recipe.raw[1]) < 0:
        raise UsageError(
            f"an image is {width}x{height}, but the module learned from images of "
            f"{recipe.raw[1]}x{recipe.raw[0]}: turn it with np.swapaxes(x, 0, 1), or crop it"
        )
    little = "<f4" if known == "32FC1" else f"<{kind}"
    data = np.ascontiguousarray(array, little).tobytes()
    return raw_image(data, height, width, known, depth=recipe.range, color=recipe.color)


def _numbers(rows: Any, recipe: Recipe) -> NDArray[np.float64]:
    """Convert rows of numbers to frames, (n, values)."""
    count = recipe.shape[0]
    try:
        numbers = np.asarray(rows)
    except ValueError:  # rows of several lengths
        numbers = np.asarray("")
    if numbers.ndim == 1 and recipe.shape == (1,):
        numbers = numbers[:, None]
    if numbers.shape[1:] != recipe.shape or numbers.dtype.kind not in "biuf":
        names = f" ({', '.join(recipe.fields)})" if recipe.fields else ""
        raise UsageError(
            f"the numbers are {numbers.dtype} {numbers.shape}: give (n, {count}), rows of the "
            f"{count} numbers that the module learned from{names}"
        )
    return bounded(numbers.astype(np.float64), recipe.range)
