"""Decoders of external data other than MCAP logs: valid inputs, and a call for each.

Only our own errors may escape, in one line each, within `SECONDS`.
"""

from __future__ import annotations

import shutil
import struct
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from io import BytesIO
from pathlib import Path
from random import Random

import numpy as np
import video_packets
from camera_files import HEIGHT, WIDTH, pictures, write_video
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from PIL import Image
from test_bags import ros1_bag, ros2_database
from test_modules import learned, with_width

from cdmisfa.core.blocks import Block
from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.learning import Keyframe
from cdmisfa.experiments.sources import Layers, configure
from recorder.images.messages import MessageKind, decoder_of
from recorder.images.options import IMAGES
from recorder.images.videos import VideoPackets
from recorder.mcap.records import MalformedRecord
from replay.logs.open_logs import open_stream
from replay.runs.codec import decode_matrices, decode_signals, encode_matrix, encode_signals
from replay.runs.folders import RUN_JSON, read_run_json
from replay.runs.keyframes import decode_keyframe, encode_keyframe
from replay.runs.modules import load_modules, save_modules
from replay.runs.provenance import facts_sha256
from tools.torture.mutations import BYTES, TEXT

from .oracle import BrokenPromise

SECONDS = 5.0
"""Processor time within which a decoder must answer any small input."""
MOST = 256 * 1024
"""Bytes of an input."""


@dataclass(frozen=True, slots=True)
class Decoder:
    """A decoder.

    Attributes:
        read: decodes a file, which is alone in its folder.
        seeds: returns valid inputs.
        name: of the file.
        text: whether inputs are text.
    """

    read: Callable[[Path], object]
    seeds: Callable[[], Iterable[bytes]]
    name: str = "input"
    text: bool = False


def mutated(rng: Random, data: bytes, other: bytes, *, text: bool) -> bytes:
    """Change an input a little, or join two."""
    changed = bytearray(data)
    if rng.random() < 0.1:
        cut = rng.randrange(len(changed) + 1)
        changed[cut:] = other[rng.randrange(len(other) + 1) :]
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        if changed:
            rng.choice(TEXT if text else BYTES)(rng, changed)
    return bytes(changed[:MOST])


def check(name: str, data: bytes, folder: Path) -> None:
    """Decode one input; raise BrokenPromise, or whatever escapes."""
    decoder = DECODERS[name]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = folder / decoder.name
    path.write_bytes(data)
    before = time.process_time()
    try:
        decoder.read(path)
    except (CdmisfaError, MalformedRecord) as error:
        if "\n" in str(error) or not str(error):
            raise BrokenPromise(f"not one line: {error!r}") from error
    if (seconds := time.process_time() - before) > SECONDS:
        raise BrokenPromise(f"it took {seconds:.1f} s")


@cache
def seeds(name: str) -> tuple[bytes, ...]:
    """Return valid inputs of a decoder."""
    return tuple(DECODERS[name].seeds())


# Messages


def _image(schema: str, encoding: str) -> Callable[[Path], object]:
    decode = decoder_of(MessageKind(schema, encoding), IMAGES)
    assert decode is not None
    return lambda path: decode(path.read_bytes())


def _video_message(kind: MessageKind) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        decode = decoder_of(kind, IMAGES)
        assert isinstance(decode, VideoPackets)
        return decode.begins(path.read_bytes()), decode(path.read_bytes())

    return read


def _video_seeds(kind: MessageKind) -> Callable[[], Iterator[bytes]]:
    write = video_packets.KINDS[kind]
    return lambda: (write(video_packets.video(c)[0], c) for c in ("h264", "h265", "vp9", "av1"))


def _packed() -> Iterator[bytes]:
    """Yield an image as PNG and JPEG, in each mode that is decoded differently."""
    gray = Image.fromarray(next(pictures(1)))
    deep = Image.fromarray(np.asarray(gray).astype(np.uint16))
    images = (gray, gray.convert("RGBA"), gray.convert("P"), deep)
    for image, form in (*((one, "PNG") for one in images), (gray, "JPEG")):
        image.save(result := BytesIO(), form)
        yield result.getvalue()
    for mode in ("RGB", "CMYK"):
        gray.convert(mode).save(result := BytesIO(), "JPEG", progressive=mode == "RGB")
        yield result.getvalue()


def _raw() -> Iterator[RawImage]:
    pixels = next(pictures(1)).tobytes()
    for encoding, size in (("mono8", 1), ("rgb8", 3), ("bgra8", 4), ("16UC1", 2)):
        shape = {"width": WIDTH, "height": HEIGHT, "step": WIDTH * size}
        yield RawImage(**shape, encoding=encoding, data=pixels * size)


def _cdr() -> Iterator[bytes]:
    for raw in _raw():
        made = video_packets.cdr(HEIGHT, WIDTH, raw.encoding.encode() + b"\0") + b"\0"
        made += bytes(-len(made) % 4) + struct.pack("<II", raw.step, len(raw.data)) + raw.data
        yield made


# Files


def _written(suffix: str, write: Callable[[Path], object]) -> Callable[[], list[bytes]]:
    def made() -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            return [path.read_bytes() for path in sorted(Path(folder).rglob(f"*{suffix}"))]

    return made


def _write_modules(folder: Path) -> None:
    save_modules(folder / "modules.npz", [replace(with_width(2), index=i) for i in (1, 2)])


def _write_video(folder: Path) -> None:
    write_video(folder / "a.mp4", pictures(5), codec="libx264", pixels="yuv420p")
    write_video(folder / "a.mkv", pictures(5))


def _cameras(path: Path) -> None:
    """Decode the first image of each topic, and the last."""
    for topic in ("/cam_left", "/cam_right") if path.suffix in (".bag", ".db3") else (None,):
        with open_stream(path, topic) as stream:
            for row in (0, stream.count - 1):
                stream.image(row)


def _presets() -> Iterator[bytes]:
    for file in resources.files("cdmisfa.presets").iterdir():
        if file.name.endswith(".toml"):
            yield file.read_bytes()


def _preset(path: Path) -> None:
    configure("icub" if b"icub" in path.read_bytes() else "oscillatory", Layers.read(str(path)))


def _run_json(path: Path) -> None:
    if document := read_run_json(path.parent):
        facts_sha256(document)


@cache
def _of_a_run() -> tuple[bytes, bytes, bytes]:
    """Return a record of signals, a matrix and a keyframe."""
    learner, (_, frames) = learned("uint8", "none")
    signals = learner.step(Block(0, 0, frames, np.empty((20, 0))))
    keyframe = Keyframe(learner.iteration, 0, learner.state, {"python": "3"})
    return encode_signals(signals), encode_matrix(3, np.eye(3)), encode_keyframe(keyframe)


DECODERS: Mapping[str, Decoder] = {
    "protobuf image": Decoder(
        _image("foxglove.RawImage", "protobuf"), lambda: (r.SerializeToString() for r in _raw())
    ),
    "protobuf packed image": Decoder(
        _image("foxglove.CompressedImage", "protobuf"),
        lambda: (CompressedImage(data=data).SerializeToString() for data in _packed()),
    ),
    "cdr image": Decoder(_image("sensor_msgs/msg/Image", "cdr"), _cdr),
    **{
        f"{kind.encoding} video of {kind.schema}": Decoder(
            _video_message(kind), _video_seeds(kind), text=kind.encoding == "json"
        )
        for kind in video_packets.KINDS
    },
    "picture": Decoder(lambda path: _cameras(path.parent), _packed, "0.png"),
    "bag": Decoder(_cameras, _written(".bag", ros1_bag), "a.bag"),
    "db3": Decoder(_cameras, _written(".db3", ros2_database), "a.db3"),
    "mkv": Decoder(_cameras, _written(".mkv", _write_video), "a.mkv"),
    "mp4": Decoder(_cameras, _written(".mp4", _write_video), "a.mp4"),
    "npz": Decoder(load_modules, _written(".npz", _write_modules), "modules.npz"),
    "signals": Decoder(lambda p: decode_signals(p.read_bytes()), lambda: _of_a_run()[:1]),
    "matrix": Decoder(lambda p: list(decode_matrices([p.read_bytes()])), lambda: _of_a_run()[1:2]),
    "keyframe": Decoder(lambda p: decode_keyframe(p.read_bytes()), lambda: _of_a_run()[2:]),
    "preset": Decoder(_preset, _presets, "a.toml", text=True),
    "run.json": Decoder(
        _run_json, lambda: [b'{"seed": 1, "result": {"signals_sha256": "0"}}'], RUN_JSON, text=True
    ),
}
