"""Decode JPEG and PNG with Pillow, and detect damage that Pillow does not report.

A PNG has a checksum for each chunk, most of which Pillow ignores. A JPEG has no checksums but an
end marker, and if it has one scan, its pixels end where its data end.
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
from PIL import ImageOps
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.untrusted import BUDGET, budget
from recorder.images.pixels import (
    ALPHA,
    GRAY,
    HIGH_BYTE,
    MAX_PIXELS,
    MalformedImage,
    by_bands,
    lost,
)

# Largest number of pixels of an image that is decoded in a thread, where no memory limit works.
MAX_THREAD_PIXELS: Final = 4_000_000

_JPEG: Final = b"\xff\xd8"
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_MARKER: Final = re.compile(rb"\xff(?=[^\x00\xff])")
_END: Final = 0xD9
_RESTARTS: Final = range(0xD0, 0xD8)

# Marker of arithmetic coding, whose data can end before its pixels do.
_ARITHMETIC: Final = b"\xff\xc9"

_SCAN: Final = b"\xff\xda"

# Largest total number of pixels of all scans of a JPEG: 20 scans of the largest image (10 are
# usual). A scan of a few bytes takes as long to decode as any other.
_MAX_SCANNED: Final = 720_000_000

# Padding after a scan: libjpeg reads up to 64 bits before it needs them.
_PADDING: Final = b"\xff\x00" * 8

# Bytes before the end marker that may hold no pixels: some cameras leave a few.
_UNUSED_BYTES: Final = 64

# Pillow's modes for 16 bits.
_WORDS: Final = ("I;16", "I;16B", "I")


def compressed_image(data: bytes, *, color: bool = False, limit: int = MAX_PIXELS) -> ByteArray:
    """Decode a JPEG or PNG to gray, (height, width) uint8.

    Args:
        data: bytes of the file.
        color: True to decode to red, green and blue, (height, width, 3).
        limit: largest number of pixels; in threads at most `MAX_THREAD_PIXELS`.

    Raises:
        MalformedImage: the data are not a JPEG or PNG, damaged, or too large.
    """
    with _decoded(data, limit) as image:
        if image.mode in _WORDS:
            words = np.asarray(image)
            lost(HIGH_BYTE)
            return by_bands(words, lambda part: (part.astype(np.int64) >> 8).clip(0, 255))
        lost(ALPHA, image.has_transparency_data)
        lost(GRAY, not color and image.mode not in ("1", "L", "LA"))
        rgb = image if image.mode in ("L", "RGB") else image.convert("RGB")
        return np.array(rgb if color else rgb.convert("L"), np.uint8)


def compressed_words(data: bytes) -> NDArray[np.uint16]:
    """Decode a PNG of 16 bits, in which ROS stores distances, to (height, width).

    Raises:
        MalformedImage: the data are not such a PNG, damaged, or too large.
    """
    with _decoded(data) as image:
        if image.mode not in _WORDS:
            raise MalformedImage(f"its distances are stored as {image.mode}, not in 16 bits")
        return np.asarray(image).astype(np.uint16)


@contextmanager
def _decoded(data: bytes, limit: int = MAX_PIXELS) -> Iterator[ImageFile]:
    """Decode a JPEG or PNG within the memory budget, and turn it upright by its EXIF."""
    try:
        with nullcontext() if limit <= MAX_THREAD_PIXELS else budget():
            jpeg = data.startswith(_JPEG)
            image = JpegImageFile(io.BytesIO(data)) if jpeg else PngImageFile(io.BytesIO(data))
            if not 0 < image.width * image.height <= limit:
                raise MalformedImage(
                    f"it has {image.width}x{image.height} pixels, more than {limit}, the limit"
                )
            if isinstance(image, JpegImageFile):
                _load_jpeg(image, data)
            else:
                _check_chunks(data)
                image.load()
            if "exif" in image.info:
                _turn_upright(image)
            yield image
    except MalformedImage:
        raise
    except MemoryError:
        raise MalformedImage(f"its image takes more than {BUDGET >> 20} MiB of memory") from None
    except Exception as error:  # Pillow raises whatever its codecs raise
        raise MalformedImage(f"its JPEG or PNG is damaged ({type(error).__name__})") from None


def _turn_upright(image: ImageFile) -> None:
    try:
        lost("images are turned upright as their EXIF states", image.getexif().get(0x0112, 1) != 1)
        ImageOps.exif_transpose(image, in_place=True)
    except MemoryError:
        raise
    except Exception:
        pass


def check_png(data: bytes) -> bool:
    """Check the checksums of a PNG without decoding it; return False for a JPEG, which has none.

    Raises:
        MalformedImage: the data are damaged, or not a JPEG or PNG.
    """
    if data.startswith(_JPEG):
        return False
    if not data.startswith(_PNG):
        raise MalformedImage("it does not begin as a PNG")
    _check_chunks(data)
    return True


def _check_chunks(data: bytes) -> None:
    """Check length and CRC-32 of each chunk of a PNG (PNG specification, 5.3)."""
    view, at, kind = memoryview(data), len(_PNG), b""
    while kind != b"IEND":
        end = at + 8 + int.from_bytes(view[at : at + 4], "big")
        kind = bytes(view[at + 4 : at + 8])
        if end + 4 > len(data):
            raise MalformedImage("its PNG is cut short")
        if zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise MalformedImage(f"its PNG is damaged: the CRC of bytes {at} to {end + 3} differs")
        at = end + 4


def _load_jpeg(image: JpegImageFile, data: bytes) -> None:
    """Decode a JPEG; if it has only one scan, without its end marker, see `_Scan`."""
    file = image.fp
    assert file is not None
    start = file.tell()
    several = image.info.get("progressive") or data[start - 4 - 2 * image.layers] != image.layers
    if several or data.find(_ARITHMETIC, 0, start) >= 0:
        if data.find(b"\xff\xd9", start) < 0:
            raise MalformedImage("its JPEG is damaged: it lacks its end marker")
        if data.count(_SCAN, start) * image.width * image.height > _MAX_SCANNED:
            raise MalformedImage(f"its JPEG has {data.count(_SCAN)} scans, which is not supported")
        image.load()
        return
    markers = ((m.start(), data[m.end()]) for m in _MARKER.finditer(data, start))
    # FFmpeg does not number restart markers in order, so any order is accepted.
    end, kind = next((m for m in markers if m[1] not in _RESTARTS), (0, 0))
    if kind != _END:
        raise MalformedImage("its JPEG is damaged: its scan does not end with an end marker")
    image.fp = scan = _Scan(data, start, end)
    image.load()
    if scan.tell() <= scan.last_part:
        raise MalformedImage("its JPEG is damaged: its pixels end before its data")


class _Scan(io.BytesIO):
    """A JPEG without its end marker, so that libjpeg does not invent missing pixels.

    The padding is enough for the bits that libjpeg reads ahead. If the pixels need more data,
    Pillow reports a truncated file. If they need less, the last part of the data is never read,
    because it is returned by a separate read.

    Args:
        data: bytes of the file.
        start: offset at which the scan begins.
        end: offset at which the scan ends.

    Attributes:
        last_part: offset at which the last part of the data begins.
    """

    def __init__(self, data: bytes, start: int, end: int) -> None:
        super().__init__(data[:end] + _PADDING)
        self.last_part = max(end - _UNUSED_BYTES, start)

    def read(self, size: int | None = -1) -> bytes:
        """Read up to the last part, or from it on."""
        before = self.last_part - self.tell()
        return super().read(min(size or before, before) if before > 0 else size)
