"""Camera logs as others would write them, small and with known pixels."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from message_files import write_mcap
from PIL import Image

from recorder.images.messages import MessageKind

HEIGHT, WIDTH = 12, 16
START_MS = 1000
RAW = MessageKind("foxglove.RawImage", "protobuf", language="protobuf")
PACKED = MessageKind("foxglove.CompressedImage", "protobuf")


def pictures(count: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Images that change slowly and are different from each other, (12, 16) uint8."""
    random = np.random.default_rng(seed)
    texture = random.integers(0, 200, (HEIGHT, WIDTH))
    for i in range(count):
        wave = 40 * np.sin(i / 7 + np.arange(WIDTH) / 3) + 10 * random.normal(size=(HEIGHT, 1))
        yield np.clip(texture + wave, 0, 255).astype(np.uint8)


def raw(image: np.ndarray, encoding: str = "mono8") -> bytes:
    """A foxglove.RawImage, (height, width, ...)."""
    height, width = image.shape[:2]
    message = RawImage(height=height, width=width, encoding=encoding, frame_id="cam")
    message.step, message.data = image.nbytes // height, np.ascontiguousarray(image).tobytes()
    return bytes(message.SerializeToString())


def encoded(image: np.ndarray, kind: str = "PNG") -> bytes:
    """A PNG or JPEG file."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, quality=95)
    return stream.getvalue()


def packed(image: np.ndarray) -> bytes:
    """A foxglove.CompressedImage, PNG."""
    return bytes(CompressedImage(data=encoded(image), format="png").SerializeToString())


def write_cameras(path: Path, cameras: Mapping[str, tuple[int, int]], **options: bool) -> None:
    """A log of foxglove.RawImage: topic to count and milliseconds between images, by time."""
    topics = {}
    for seed, (topic, (count, step)) in enumerate(cameras.items()):
        images = enumerate(pictures(count, seed))
        topics[topic] = [(START_MS + i * step, image) for i, image in images]
    write_images(path, topics, **options)


def write_images(
    path: Path,
    topics: Mapping[str, Iterable[tuple[int, np.ndarray]]],
    profile: str = "",
    **options: bool,
) -> Path:
    """A log of foxglove.RawImage: on each topic milliseconds and images; by time."""
    messages = {
        topic: [(ms * 1_000_000, raw(image)) for ms, image in images]
        for topic, images in topics.items()
    }
    return write_mcap(path, RAW, messages, by_time=True, profile=profile, **options)


def write_pictures(folder: Path, count: int) -> list[int]:
    """PNG files 0.png, 1.png, ... 10.png ...; gives the value of each one's first pixel."""
    folder.mkdir()
    values = []
    for i, image in enumerate(pictures(count)):
        Image.fromarray(image).save(folder / f"{i}.png")
        values.append(int(image[0, 0]))
    return values


def write_video(
    path: Path,
    images: Iterable[np.ndarray],
    *,
    codec: str = "ffv1",
    pixels: str = "gray",
    fps: int = 25,
    first: int = 0,
    drop: frozenset[int] = frozenset(),
    options: Mapping[str, str] | None = None,
) -> list[np.ndarray]:
    """Four pixels for each of an image's; `first` and `drop` move and leave out frames.

    The options are those of the container and, as g, of the codec.
    """
    import av

    written = []
    chosen = dict(options or {})
    group = {"g": chosen.pop("g")} if "g" in chosen else {}
    with av.open(str(path), "w", options=chosen) as container:
        stream = container.add_stream(codec, rate=fps, options=group)
        stream.width, stream.height, stream.pix_fmt = 4 * WIDTH, 4 * HEIGHT, pixels
        stream.codec_context.time_base = Fraction(1, fps)
        for i, image in enumerate(images):
            if i in drop:
                continue
            frame = av.VideoFrame.from_ndarray(image.repeat(4, 0).repeat(4, 1), format="gray")
            frame.pts = first + i
            written.append(image)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return written
