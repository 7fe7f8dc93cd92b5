"""JPEG and PNG files, decoded by Pillow, and refused where they tell that they are damaged.

A PNG has checksums of all of it, of which Pillow checks few. A JPEG has none, but an end, and where
it is of one scan its pixels end where its data do. Pillow silences what libjpeg says of both.
"""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.untrusted import BUDGET, budget
from recorder.images.pixels import MAX_PIXELS, MalformedImage, by_bands

_JPEG: Final = b"\xff\xd8"
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_MARKER: Final = re.compile(rb"\xff(?=[^\x00\xff])")
_END: Final = 0xD9
_RESTARTS: Final = range(0xD0, 0xD8)
_ARITHMETIC: Final = b"\xff\xc9"
"""Begins a JPEG of arithmetic coding, whose data may end before its pixels."""

_SCAN: Final = b"\xff\xda"
_MOST_SCANNED: Final = 720_000_000
"""Most pixels of all scans of a JPEG: 20 of the largest image; 10 are usual. A scan may have a few
bytes, and takes as long as any."""

_AHEAD: Final = b"\xff\x00" * 8
"""Bits that stand for nothing; libjpeg reads up to 64 before it needs them."""

_NO_END: Final = "its JPEG is damaged: it lacks its end marker"
_LEFT: Final = 64
"""Bytes before the end that may stand for nothing, too: some cameras leave a few."""


AT_ONCE: Final = 4_000_000
"""Most pixels of an image that is decoded beside others, without a limit to the memory it takes."""

_WORDS: Final = ("I;16", "I;16B", "I")
"""Pillow's modes of 16 bit."""

_ORIENTATION: Final = 0x0112
"""The tag of EXIF that says how a camera was held."""

_TURNS: Final = (
    *("FLIP_LEFT_RIGHT", "ROTATE_180", "FLIP_TOP_BOTTOM", "TRANSPOSE"),
    *("ROTATE_270", "TRANSVERSE", "ROTATE_90"),
)
"""What puts an image upright, by its orientation from 2 on; 1 is."""


def compressed_image(data: bytes, *, color: bool = False, most: int = MAX_PIXELS) -> ByteArray:
    """The image in a JPEG or PNG, gray, (height, width) uint8.

    Args:
        data: the file.
        color: give what has colours as they are, (height, width, 3) red, green and blue.
        most: its pixels at most; no more than `AT_ONCE` in several threads at once.

    Raises:
        MalformedImage: it is neither, broken, or too large.
    """
    with _opened(data, most) as image:
        if image.mode in _WORDS:
            words = np.asarray(image)
            return by_bands(words, lambda part: (part.astype(np.int64) >> 8).clip(0, 255))
        if image.mode not in ("L", "RGB"):
            image = image.convert("RGB")
        return np.array(image if color else image.convert("L"), np.uint8)


def compressed_words(data: bytes) -> NDArray[np.uint16]:
    """Decode a PNG of 16 bit, as distances are packed in, into (height, width).

    Raises:
        MalformedImage: it is none, broken, or too large.
    """
    with _opened(data) as image:
        if image.mode not in _WORDS:
            raise MalformedImage(f"its distances are packed as {image.mode}, not in 16 bit")
        return np.asarray(image).astype(np.uint16)


@contextmanager
def _opened(data: bytes, most: int = MAX_PIXELS) -> Iterator[Image.Image]:
    """Decode a JPEG or PNG, turned upright."""
    limit = f"more than {BUDGET >> 20} MiB of memory, the limit"
    try:
        with nullcontext() if most <= AT_ONCE else budget():
            file = open_picture(data)
            if not 0 < file.width * file.height <= most:
                raise MalformedImage(f"an image of {file.width}x{file.height} is not read")
            # Of a progressive JPEG all coefficients are held until its end.
            held = file.width * file.height * (2 * len(file.getbands()) + 4)
            if file.info.get("progressive") and held > BUDGET:
                raise MalformedImage(
                    f"a progressive JPEG of {file.width}x{file.height} in {file.mode} takes {limit}"
                )
            load_picture(file, data)
            image: Image.Image = file
            if 2 <= (orientation := _orientation(image)) <= 8:
                image = image.transpose(Image.Transpose[_TURNS[orientation - 2]])
            yield image
    except MalformedImage:
        raise
    except MemoryError:
        raise MalformedImage(f"its JPEG or PNG takes {limit}") from None
    except Exception as error:  # Pillow raises whatever its codecs raise
        raise MalformedImage(f"its JPEG or PNG is broken ({type(error).__name__})") from None


def _orientation(image: Image.Image) -> int:
    """EXIF's orientation, 1 to 8; 1, upright, where it is missing or broken."""
    if "exif" not in image.info:
        return 1
    try:
        return int(image.getexif().get(_ORIENTATION, 1))
    except Exception:  # Pillow raises whatever its parser raises; the picture may be whole
        return 1


def open_picture(data: bytes) -> ImageFile:
    """Read the head of a JPEG or PNG; its pixels are for `load_picture`.

    Raises:
        MalformedImage: it is a damaged PNG.
        Exception: whatever Pillow raises where it is neither, or broken.
    """
    if data.startswith(_JPEG):
        return JpegImageFile(io.BytesIO(data))
    image = PngImageFile(io.BytesIO(data))
    _check_chunks(data)
    return image


def load_picture(image: ImageFile, data: bytes) -> None:
    """Decode what `open_picture` opened.

    Raises:
        MalformedImage: it is a damaged JPEG.
        Exception: whatever Pillow raises where it is broken.
    """
    if isinstance(image, JpegImageFile):
        _load_jpeg(image, data)
    else:
        image.load()


def check_png(data: bytes) -> bool:
    """Check the checksums of a PNG without decoding it; false of a JPEG, which has none.

    Raises:
        MalformedImage: it is damaged, or neither.
    """
    if data.startswith(_JPEG):
        return False
    if not data.startswith(_PNG):
        raise MalformedImage("it does not begin as a PNG")
    _check_chunks(data)
    return True


def _check_chunks(data: bytes) -> None:
    """Check the length and the CRC-32 of each chunk of a PNG; see its specification, 5.3."""
    view, at, kind = memoryview(data), len(_PNG), b""
    while kind != b"IEND":
        end = at + 8 + int.from_bytes(view[at : at + 4], "big")
        kind = bytes(view[at + 4 : at + 8])
        if end + 4 > len(data):
            raise MalformedImage("its PNG is cut short")
        if zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise MalformedImage(f"its PNG is damaged: bytes {at} to {end + 3} do not match a CRC")
        at = end + 4


def _load_jpeg(image: JpegImageFile, data: bytes) -> None:
    """Decode a JPEG; where its pixels are in one scan, without its end, see `_Scan`."""
    file = image.fp
    assert file is not None
    start = file.tell()
    scans = image.info.get("progressive") or data[start - 4 - 2 * image.layers] != image.layers
    if scans or data.find(_ARITHMETIC, 0, start) >= 0:
        if data.find(b"\xff\xd9", start) < 0:
            raise MalformedImage(_NO_END)
        if data.count(_SCAN, start) * image.width * image.height > _MOST_SCANNED:
            raise MalformedImage(f"a JPEG of {data.count(_SCAN)} scans is not read")
        image.load()
        return
    image.fp = scan = _Scan(data, start, _end_of(data, start))
    image.load()
    if scan.tell() <= scan.most:
        raise MalformedImage("its JPEG is damaged: its pixels end before its data")


def _end_of(data: bytes, start: int) -> int:
    """Where the end marker is of a scan; restarts, as FFmpeg numbers them, are in any order."""
    for found in _MARKER.finditer(data, start):
        kind = data[found.end()]
        if kind == _END:
            return found.start()
        if kind not in _RESTARTS:
            raise MalformedImage(f"its JPEG is damaged: no marker {kind:02x} belongs there")
    raise MalformedImage(_NO_END)


class _Scan(io.BytesIO):
    """A JPEG without its end, from where on libjpeg would make up the pixels that are missing.

    What follows is enough for what it reads ahead. Pixels that need more are an error of Pillow's:
    the file is truncated. Pixels that need less leave the last part, which is read by itself.

    Args:
        data: the file.
        start: where its scan begins.
        end: where its scan ends.

    Attributes:
        most: where the last part begins.
    """

    def __init__(self, data: bytes, start: int, end: int) -> None:
        super().__init__(data[:end] + _AHEAD)
        self.most = max(end - _LEFT, start)

    def read(self, size: int | None = -1) -> bytes:
        """The next bytes, up to the last part, or of it."""
        before = self.most - self.tell()
        return super().read(min(size or before, before) if before > 0 else size)
