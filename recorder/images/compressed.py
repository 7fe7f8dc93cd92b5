"""Decode JPEG and PNG with Pillow, and reject what their formats show to be damaged.

A PNG has a checksum for each chunk, of which Pillow checks few. A JPEG has no checksums, but an end
marker, and if it has one scan its pixels end where its data end. Pillow hides what libjpeg reports.
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
from recorder.images.pixels import MAX_PIXELS, MalformedImage, by_bands

# Pixels of the largest image that is decoded in a thread, where no memory limit is possible.
AT_ONCE: Final = 4_000_000

_JPEG: Final = b"\xff\xd8"
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_MARKER: Final = re.compile(rb"\xff(?=[^\x00\xff])")
_END: Final = 0xD9
_RESTARTS: Final = range(0xD0, 0xD8)

# Marker of arithmetic coding, with which data may end before the pixels do.
_ARITHMETIC: Final = b"\xff\xc9"

_SCAN: Final = b"\xff\xda"

# Most pixels of all scans of a JPEG: 20 scans of the largest image; 10 are usual. A scan of a few
# bytes takes as long as any other.
_MOST_SCANNED: Final = 720_000_000

# Padding behind a scan: libjpeg reads up to 64 bits before it needs them.
_AHEAD: Final = b"\xff\x00" * 8

# Bytes before the end marker that may hold no pixels: some cameras leave a few.
_LEFT: Final = 64

# Pillow's modes for 16 bits.
_WORDS: Final = ("I;16", "I;16B", "I")


def compressed_image(data: bytes, *, color: bool = False, most: int = MAX_PIXELS) -> ByteArray:
    """Decode a JPEG or PNG to gray, (height, width) uint8.

    Args:
        data: the file.
        color: decode colours to red, green and blue, (height, width, 3).
        most: the largest number of pixels; threads must not ask for more than `AT_ONCE`.

    Raises:
        MalformedImage: the data are neither, broken, or too large.
    """
    with _decoded(data, most) as image:
        if image.mode in _WORDS:
            words = np.asarray(image)
            return by_bands(words, lambda part: (part.astype(np.int64) >> 8).clip(0, 255))
        rgb = image if image.mode in ("L", "RGB") else image.convert("RGB")
        return np.array(rgb if color else rgb.convert("L"), np.uint8)


def compressed_words(data: bytes) -> NDArray[np.uint16]:
    """Decode a PNG of 16 bits, in which ROS packs distances, to (height, width).

    Raises:
        MalformedImage: the data are no such PNG, broken, or too large.
    """
    with _decoded(data) as image:
        if image.mode not in _WORDS:
            raise MalformedImage(f"its distances are packed as {image.mode}, not in 16 bit")
        return np.asarray(image).astype(np.uint16)


@contextmanager
def _decoded(data: bytes, most: int = MAX_PIXELS) -> Iterator[ImageFile]:
    """Decode a JPEG or PNG, turned upright by its EXIF, within the memory budget."""
    try:
        with nullcontext() if most <= AT_ONCE else budget():
            jpeg = data.startswith(_JPEG)
            image = JpegImageFile(io.BytesIO(data)) if jpeg else PngImageFile(io.BytesIO(data))
            if not 0 < image.width * image.height <= most:
                raise MalformedImage(f"an image of {image.width}x{image.height} is not read")
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
        raise MalformedImage(
            f"its JPEG or PNG takes more than {BUDGET >> 20} MiB of memory, the limit"
        ) from None
    except Exception as error:  # Pillow raises whatever its codecs raise
        raise MalformedImage(f"its JPEG or PNG is broken ({type(error).__name__})") from None


def _turn_upright(image: ImageFile) -> None:
    try:
        ImageOps.exif_transpose(image, in_place=True)
    except MemoryError:
        raise
    except Exception:
        pass


def check_png(data: bytes) -> bool:
    """Check the checksums of a PNG without decoding it; return False for a JPEG, which has none.

    Raises:
        MalformedImage: the data are damaged, or neither.
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
    """Decode a JPEG; if its pixels are in one scan, without its end marker, see `_Scan`."""
    file = image.fp
    assert file is not None
    start = file.tell()
    several = image.info.get("progressive") or data[start - 4 - 2 * image.layers] != image.layers
    if several or data.find(_ARITHMETIC, 0, start) >= 0:
        if data.find(b"\xff\xd9", start) < 0:
            raise MalformedImage("its JPEG is damaged: it lacks its end marker")
        if data.count(_SCAN, start) * image.width * image.height > _MOST_SCANNED:
            raise MalformedImage(f"a JPEG of {data.count(_SCAN)} scans is not read")
        image.load()
        return
    markers = ((m.start(), data[m.end()]) for m in _MARKER.finditer(data, start))
    # FFmpeg does not number restart markers in order: any order is accepted.
    end, kind = next((m for m in markers if m[1] not in _RESTARTS), (0, 0))
    if kind != _END:
        raise MalformedImage("its JPEG is damaged: its scan does not end with an end marker")
    image.fp = scan = _Scan(data, start, end)
    image.load()
    if scan.tell() <= scan.most:
        raise MalformedImage("its JPEG is damaged: its pixels end before its data")


class _Scan(io.BytesIO):
    """A JPEG without its end marker: libjpeg would invent all pixels that are missing before it.

    The padding is enough for what libjpeg reads ahead. If pixels need more, Pillow reports that
    the file is truncated. If they need less, the last part is never read, as it is read alone.

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
        """Read up to the last part, or from it."""
        before = self.most - self.tell()
        return super().read(min(size or before, before) if before > 0 else size)
