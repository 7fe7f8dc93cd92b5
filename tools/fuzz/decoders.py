"""Everything that decodes what others may have written, but logs: inputs to begin with, and a call.

Only our errors escape, in one line each, in `SECONDS` and `MEGABYTES`.
"""

from __future__ import annotations

import base64
import json
import shutil
import struct
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.util import find_spec
from io import BytesIO
from itertools import islice
from pathlib import Path
from random import Random
from resource import RUSAGE_SELF, getpagesize, getrusage

import numpy as np
import video_packets
from camera_files import HEIGHT, WIDTH, pictures
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from PIL import Image

from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.learning import Keyframe
from cdmisfa.experiments.results import results
from cdmisfa.experiments.sources import configure
from cdmisfa.experiments.store import DONE, ROWS
from recorder.images.decoding import MessageKind
from recorder.images.messages import image_decoder
from recorder.images.videos import VideoPackets
from recorder.log.files import RECORDING
from recorder.log.manifest import read_start
from recorder.mcap.records import MalformedRecord
from replay.camera_logs.opening import open_images
from replay.export.lerobot import write_dataset
from replay.recordings.source import RecordedSource
from replay.runs.codec import decode_matrix, decode_signals, encode_matrix, encode_signals
from replay.runs.folders import REQUEST, RUN_JSON, read_run_json
from replay.runs.keyframes import decode_keyframe, encode_keyframe
from replay.runs.modules import load_modules, save_modules
from replay.runs.run import facts_sha256
from tools.torture.mutations import BYTES, TEXT

from . import datasets, mutations
from .oracle import BrokenPromise

SECONDS = 5.0
"""Of processor time in which any small input must have been answered."""
MEGABYTES = 512
"""Most memory that a command may ever have."""
OWN = 112
"""Of these what it has before it reads anything; where tests ran before, this process has more."""
MOST = 256 * 1024
"""Bytes of an input."""

OURS = (CdmisfaError, MalformedRecord)


@dataclass(frozen=True, slots=True)
class Decoder:
    """Something that decodes.

    Attributes:
        read: told of a file in a folder of its own.
        seeds: inputs that are whole.
        name: of the file.
        text: whether it is of words rather than bytes.
        needs: a package that may be missing.
    """

    read: Callable[[Path], object]
    seeds: Callable[[], Iterable[bytes]]
    name: str = "input"
    text: bool = False
    needs: str = ""


def mutated(rng: Random, data: bytes, other: bytes, *, text: bool) -> bytes:
    """An input that was changed a little, or put together of two."""
    changed = bytearray(data)
    if rng.random() < 0.1:
        cut = rng.randrange(len(changed) + 1)
        changed[cut:] = other[rng.randrange(len(other) + 1) :]
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        if changed:
            rng.choice(TEXT if text else BYTES)(rng, changed)
    return bytes(changed[:MOST])


def check(name: str, data: bytes, folder: Path) -> None:
    """Decode one input.

    Raises:
        BrokenPromise: it took too long or too much, or an error is no line.
        Exception: whatever else escaped.
    """
    decoder = DECODERS[name]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = folder / decoder.name
    path.write_bytes(data)
    before = time.process_time()
    most = max(_megabytes(), MEGABYTES, _resident() + MEGABYTES - OWN)
    try:
        decoder.read(path)
    except OURS as error:
        if "\n" in str(error) or not str(error):
            raise BrokenPromise(f"not one line: {error!r}") from error
    if (took := time.process_time() - before) > SECONDS:
        raise BrokenPromise(f"it took {took:.1f} s")
    if _megabytes() > most:
        raise BrokenPromise(f"it took {_megabytes()} MB")


def available() -> list[str]:
    """Names of the decoders whose packages are installed."""
    return [name for name, one in DECODERS.items() if not one.needs or find_spec(one.needs)]


@cache
def seeds(name: str) -> tuple[bytes, ...]:
    """Whole inputs of a decoder; each of them must be read."""
    return tuple(DECODERS[name].seeds())


def _megabytes() -> int:
    """Most memory that this process ever had."""
    return getrusage(RUSAGE_SELF).ru_maxrss // 1024


def _resident() -> int:
    """Memory that this process has now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * getpagesize() >> 20


# Messages of images


def _image(schema: str, encoding: str) -> Callable[[Path], object]:
    decode = image_decoder(schema, encoding)
    assert decode is not None
    return lambda path: decode(path.read_bytes())


def _video_message(schema: str, encoding: str) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        decode = image_decoder(schema, encoding)
        assert isinstance(decode, VideoPackets)
        return decode.begins(path.read_bytes()), decode(path.read_bytes())

    return read


def _video_messages(schema: str, encoding: str) -> Callable[[], Iterator[bytes]]:
    write = video_packets.KINDS[MessageKind(schema, encoding)]
    return lambda: (write(video_packets.video(c)[0], c) for c in ("h264", "h265", "vp9", "av1"))


def _pixels() -> bytes:
    return next(pictures(1)).tobytes()


def _packed() -> Iterator[bytes]:
    """The same picture as PNG and JPEG, of every mode that is read otherwise."""
    gray = Image.fromarray(next(pictures(1)))
    for mode, form in (("L", "PNG"), ("RGBA", "PNG"), ("P", "PNG"), ("I;16", "PNG")):
        image = Image.fromarray(np.asarray(gray).astype(np.uint16)) if ";" in mode else gray
        yield _saved(image if ";" in mode else image.convert(mode), form)
    for mode in ("L", "RGB", "CMYK"):
        yield _saved(gray.convert(mode), "JPEG")
    yield _saved(gray, "JPEG", progressive=True)


def _saved(image: Image.Image, form: str, **options: object) -> bytes:
    image.save(found := BytesIO(), form, **options)
    return found.getvalue()


def _raw_seeds() -> Iterator[bytes]:
    for encoding, size in (("mono8", 1), ("rgb8", 3), ("bgra8", 4), ("16UC1", 2)):
        step = WIDTH * size
        yield RawImage(
            width=WIDTH, height=HEIGHT, step=step, encoding=encoding, data=_pixels() * size
        ).SerializeToString()


def _json_seeds() -> Iterator[bytes]:
    for raw in map(RawImage.FromString, _raw_seeds()):
        fields = {"width": WIDTH, "height": HEIGHT, "step": raw.step, "encoding": raw.encoding}
        yield json.dumps({**fields, "data": base64.b64encode(raw.data).decode()}).encode()


def _ros(ros1: bool, *, order: str = "<", compressed: bool = False) -> Iterator[bytes]:
    """Messages as ROS writes them: packed, or aligned after four bytes."""

    def put(fields: Iterable[int | bytes]) -> bytes:
        out = b"" if ros1 else bytes((0, order == "<", 0, 0))
        for field in fields:
            if isinstance(field, int) or len(field) != 1:
                out += b"" if ros1 else bytes(-len(out) % 4)
                out += struct.pack(f"{order}I", field if isinstance(field, int) else len(field))
            out += b"" if isinstance(field, int) else field
        return out

    end = b"" if ros1 else b"\0"
    head = (*([7] if ros1 else []), 1, 2, b"cam" + end)
    if compressed:
        yield from (put((*head, b"png" + end, data)) for data in _packed())
        return
    for raw in map(RawImage.FromString, _raw_seeds()):
        encoding = raw.encoding.encode() + end
        yield put((*head, HEIGHT, WIDTH, encoding, b"\0", raw.step, raw.data))


# Files


def _written(suffix: str, write: Callable[[Path], object]) -> Callable[[], list[bytes]]:
    def made() -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            write(place)
            return [path.read_bytes() for path in sorted(place.rglob(f"*{suffix}"))]

    return made


def _modules(folder: Path) -> None:
    from dataclasses import replace

    from test_modules import with_width

    save_modules(folder / "modules.npz", [replace(with_width(2), index=i) for i in (1, 2)])


def _bag(folder: Path) -> None:
    from test_bags import ros1_bag

    ros1_bag(folder)


def _database(folder: Path) -> None:
    from test_bags import ros2_database

    ros2_database(folder)


def _video(suffix: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        from camera_files import write_video

        codec = {"codec": "libx264", "pixels": "yuv420p"} if suffix == ".mp4" else {}
        write_video(folder / f"a{suffix}", pictures(5), **codec)

    return write


def _cameras(path: Path) -> None:
    """The first image of each topic, and the last."""
    for topic in ("/cam_left", "/cam_right") if path.suffix in (".bag", ".db3") else (None,):
        datasets.first_and_last(path, topic)


def _presets() -> Iterator[bytes]:
    for file in resources.files("cdmisfa.presets").iterdir():
        if file.name.endswith(".toml"):
            yield file.read_bytes()


def _preset(path: Path) -> None:
    configure("icub" if b"icub" in path.read_bytes() else "oscillatory", str(path))


def _set(path: Path) -> None:
    configure("oscillatory", None, path.read_bytes().decode("utf-8", "surrogateescape").split("\n"))


def _run_json(path: Path) -> None:
    document = read_run_json(path.parent)
    if document:
        facts_sha256(document)


def _sweep_seed() -> Iterator[bytes]:
    """A request and its rows, in one input."""
    request = {"trials": [{"id": "a", "point": {"learner.nu": 0.1}}]}
    result = {"iterations": 9, "modules": [], "ended": "max_iterations", "frames": 90}
    row = {"id": "a", "status": DONE, "point": {"learner.nu": 0.1}, "result": result}
    yield json.dumps(request).encode() + b"\n" + json.dumps(row).encode() + b"\n"


def _sweep(path: Path) -> None:
    request, _, rows = path.read_bytes().partition(b"\n")
    (path.parent / REQUEST).write_bytes(request)
    (path.parent / ROWS).write_bytes(rows)
    results(path.parent)


@cache
def _of_a_run() -> tuple[bytes, bytes, bytes]:
    """A record of signals, a matrix and a keyframe."""
    from test_modules import learned

    from cdmisfa.core.blocks import Block

    learner, (_, frames) = learned("uint8", "none")
    signals = learner.step(Block(0, 0, frames, np.empty((20, 0))))
    keyframe = Keyframe(learner.iteration, 0, learner.state, {"python": "3"})
    return encode_signals(signals), encode_matrix(3, np.eye(3)), encode_keyframe(keyframe)


def _lerobot(path: Path) -> None:
    source = RecordedSource([path])
    try:
        if source.frames <= 1000:
            write_dataset([source], path.parent / "dataset", name="it", lossless=True)
    finally:
        source.close()


DECODERS: Mapping[str, Decoder] = {
    "json image": Decoder(_image("foxglove.RawImage", "json"), _json_seeds, text=True),
    "protobuf image": Decoder(_image("foxglove.RawImage", "protobuf"), _raw_seeds),
    "protobuf packed image": Decoder(
        _image("foxglove.CompressedImage", "protobuf"),
        lambda: (CompressedImage(data=data).SerializeToString() for data in _packed()),
    ),
    "ros1 image": Decoder(_image("sensor_msgs/Image", "ros1"), lambda: _ros(True)),
    "ros1 packed image": Decoder(
        _image("sensor_msgs/CompressedImage", "ros1"), lambda: _ros(True, compressed=True)
    ),
    "cdr image": Decoder(
        _image("sensor_msgs/msg/Image", "cdr"),
        lambda: (*_ros(False), *_ros(False, order=">")),
    ),
    "cdr packed image": Decoder(
        _image("sensor_msgs/msg/CompressedImage", "cdr"), lambda: _ros(False, compressed=True)
    ),
    **{
        f"{kind.encoding} video of {kind.schema}": Decoder(
            _video_message(kind.schema, kind.encoding),
            _video_messages(kind.schema, kind.encoding),
            text=kind.encoding == "json",
            needs="av",
        )
        for kind in video_packets.KINDS
    },
    "picture": Decoder(lambda p: open_images(p.parent, None).image(0), _packed, "0.png"),
    "bag": Decoder(_cameras, _written(".bag", _bag), "a.bag", needs="rosbags"),
    "db3": Decoder(_cameras, _written(".db3", _database), "a.db3", needs="rosbags"),
    "metadata.yaml": Decoder(
        datasets.read_bag, datasets.metadata, "metadata.yaml", text=True, needs="rosbags"
    ),
    "parquet": Decoder(datasets.read_dataset, datasets.frames, datasets.FRAMES, needs="pyarrow"),
    "parquet of episodes": Decoder(
        datasets.read_dataset, datasets.episodes, "episodes.parquet", needs="pyarrow"
    ),
    "mkv": Decoder(_cameras, _written(".mkv", _video(".mkv")), "a.mkv", needs="av"),
    "mp4": Decoder(_cameras, _written(".mp4", _video(".mp4")), "a.mp4", needs="av"),
    "lerobot": Decoder(
        _lerobot, lambda: list(islice(mutations.bases().values(), 3)), "v.mcap", needs="av"
    ),
    "npz": Decoder(load_modules, _written(".npz", _modules), "modules.npz"),
    "signals": Decoder(lambda p: decode_signals(p.read_bytes()), lambda: _of_a_run()[:1]),
    "matrix": Decoder(lambda p: decode_matrix(p.read_bytes()), lambda: _of_a_run()[1:2]),
    "keyframe": Decoder(lambda p: decode_keyframe(p.read_bytes()), lambda: _of_a_run()[2:]),
    "preset": Decoder(_preset, _presets, "a.toml", text=True),
    "settings": Decoder(_set, lambda: [b"learner.nu=0.1\nscene.streams=x1,x2"], text=True),
    "run.json": Decoder(
        _run_json, lambda: [b'{"seed": 1, "result": {"signals_sha256": "0"}}'], RUN_JSON, text=True
    ),
    "recording.json": Decoder(
        lambda p: read_start(p.parent),
        lambda: [b'{"frames": {"a": 9}, "split": {"a": "5s"}, "scene": "icub", "seed": 1}'],
        RECORDING,
        text=True,
    ),
    "sweep": Decoder(_sweep, _sweep_seed, text=True),
}
