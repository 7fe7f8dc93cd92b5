"""Camera logs as others would write them, small and with known pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import Writer
from PIL import Image

HEIGHT, WIDTH = 12, 16
START_MS = 1000


def pictures(count: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Images that change slowly and are different from each other, (12, 16) uint8."""
    random = np.random.default_rng(seed)
    texture = random.integers(0, 200, (HEIGHT, WIDTH))
    for i in range(count):
        wave = 40 * np.sin(i / 7 + np.arange(WIDTH) / 3) + 10 * random.normal(size=(HEIGHT, 1))
        yield np.clip(texture + wave, 0, 255).astype(np.uint8)


def write_cameras(path: Path, cameras: Mapping[str, tuple[int, int]]) -> None:
    """An MCAP log of foxglove.RawImage: topic to count and milliseconds between images."""
    messages = []
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8192)
        writer.start()
        schema = writer.register_schema("foxglove.RawImage", "protobuf", b"")
        for seed, (topic, (count, step)) in enumerate(cameras.items()):
            channel = writer.register_channel(topic, "protobuf", schema)
            for i, image in enumerate(pictures(count, seed)):
                message = RawImage(
                    width=WIDTH, height=HEIGHT, step=WIDTH, encoding="mono8", data=image.tobytes()
                )
                messages.append((START_MS + i * step, channel, message.SerializeToString()))
        for time, channel, data in sorted(messages):
            writer.add_message(channel, time * 1_000_000, data, time * 1_000_000)
        writer.finish()


def write_pictures(folder: Path, count: int) -> list[int]:
    """PNG files 0.png, 1.png, ... 10.png ...; gives the value of each one's first pixel."""
    folder.mkdir()
    values = []
    for i, image in enumerate(pictures(count)):
        Image.fromarray(image).save(folder / f"{i}.png")
        values.append(int(image[0, 0]))
    return values
