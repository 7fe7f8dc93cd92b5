"""No reader drops, shrinks or reinterprets data without a line on stderr and in --json."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import PACKED, RAW, raw
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.writer import Writer
from message_files import every, write_mcap, write_table
from PIL import Image

from recorder.images.messages import MessageKind
from recorder.images.options import InputOptions
from replay.export.formats import export

Write = Callable[[Path], Path]

COUNT, STEP = 30, 20_000_000
JOINTS = MessageKind("JointState", "json")
IMAGE, TEXT = "sensor_msgs/msg/Image", "std_msgs/msg/String"
HEADER, TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
TURNED = Image.Exif()
TURNED[0x0112] = 3


def ramp(*shape: int, dtype: Any = np.uint8, high: float = 255) -> np.ndarray:
    """Images that drift, (COUNT, 12, 16, ...)."""
    t = np.arange(COUNT).reshape(-1, 1, 1, *[1] * len(shape))
    x = np.arange(16).reshape(16, *[1] * len(shape))
    waves = (1 + np.sin(t / 9 + x / 3)) / 2 * np.ones((COUNT, 12, 16, *shape))
    return (waves * high).astype(dtype)


def files(images: np.ndarray, form: str = "PNG", **options: Any) -> list[bytes]:
    streams = [io.BytesIO() for _ in images]
    for image, stream in zip(images, streams, strict=True):
        Image.fromarray(image).save(stream, form, **options)
    return [stream.getvalue() for stream in streams]


def mcap(kind: MessageKind, messages: Any) -> Write:
    return lambda folder: write_mcap(folder / "log.mcap", kind, {"/a": every(STEP, messages)})


def raws(images: np.ndarray, encoding: str) -> Write:
    return mcap(RAW, [raw(image, encoding) for image in images])


def packed(images: list[bytes]) -> Write:
    return mcap(PACKED, [CompressedImage(data=data).SerializeToString() for data in images])


def joints(*rows: Any) -> Write:
    return mcap(JOINTS, [json.dumps({"x": rows[i % len(rows)]}).encode() for i in range(COUNT)])


def table(**columns: Any) -> Write:
    return lambda folder: write_table(folder / "t.parquet", columns)


def images(data: list[bytes], ending: str = "png") -> Write:
    def write(folder: Path) -> Path:
        for i, each in enumerate(data):
            (folder / f"{i}.{ending}").write_bytes(each)
        return folder

    return write


def array(values: np.ndarray, ending: str = "npy") -> Write:
    def write(folder: Path) -> Path:
        path = folder / f"a.{ending}"
        np.savez(path, a=values) if ending == "npz" else np.save(path, values)
        return path

    return write


def mixed(folder: Path) -> Path:
    with (folder / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for kind, topic in ((RAW, "/cam"), (JOINTS, "/joints")):
            schema = writer.register_schema(kind.schema, kind.language, kind.definition)
            channel = writer.register_channel(topic, kind.encoding, schema)
            for i, image in enumerate(ramp()):
                data = raw(image) if kind is RAW else json.dumps({"x": [i, -i]}).encode()
                writer.add_message(channel, 10**18 + i * STEP, data, 0)
        writer.finish()
    return folder / "log.mcap"


def dataset(folder: Path) -> Path:
    pytest.importorskip("av")
    inputs = InputOptions(topics=("/cam", "/joints"))
    export(mixed(folder), folder / "data", "lerobot", inputs=inputs, lossless=True)
    return folder / "data"


def bag(frames: np.ndarray, encoding: str) -> Write:
    def write(folder: Path) -> Path:
        bags, ros = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
        store = ros.get_typestore(ros.Stores.ROS2_HUMBLE)
        image, header, time = (store.types[name] for name in (IMAGE, HEADER, TIME))
        head = header(stamp=time(sec=1, nanosec=2), frame_id="cam")
        with bags.Writer(folder / "bag", version=9) as writer:
            cam = writer.add_connection("/cam", IMAGE, typestore=store)
            writer.add_connection("/chatter", TEXT, typestore=store)
            for i, x in enumerate(frames):
                pixels = np.frombuffer(x.tobytes(), np.uint8)
                message = image(head, 12, 16, encoding, 0, x.nbytes // 12, pixels)
                writer.write(cam, 10**18 + i * STEP, store.serialize_cdr(message, IMAGE))
        return folder / "bag"

    return write


def video(form: str, tracks: int = 1) -> Write:
    def write(folder: Path) -> Path:
        av = pytest.importorskip("av")
        with av.open(str(folder / "v.mkv"), "w") as container:
            streams = [container.add_stream("ffv1", rate=Fraction(50)) for _ in range(tracks)]
            for stream in streams:
                stream.width, stream.height, stream.pix_fmt = 16, 12, form
            for stream in streams:
                for image in ramp(3) * np.array([1, 1, 0], np.uint8):
                    frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=form)
                    container.mux(stream.encode(frame))
                container.mux(stream.encode())
        return folder / "v.mkv"

    return write


WORDS, BIG = ramp(dtype=np.uint16, high=65535), np.arange(2**53, 2**53 + COUNT)
FLOATS, LARGE = ramp(dtype=np.float32, high=1), ramp().repeat(12, 1).repeat(12, 2)
GRAY, HIGH, ALPHA = "colors become gray", "reduced to their high byte", "transparency is ignored"
EXIF, LEFT_OUT = "turned upright as their EXIF", "left out, unless named by --topic: "
ROUNDED, RANGE = "numbers above 2^53 may be rounded to float64", "--set input.range=1,9"

# What a reader is given, the options, and the line or the refusal; "" if nothing is lost.
ROWS: dict[str, tuple[Write, str, str]] = {
    "mcap colors": (raws(ramp(3), "rgb8"), "", GRAY),
    "mcap alpha": (raws(ramp(4), "rgba8"), "", ALPHA),
    "mcap 16 bit": (raws(WORDS, "mono16"), "", HIGH),
    "mcap 16 bit in a range": (raws(WORDS, "mono16"), RANGE, "no distances for input.range"),
    "images 16 bit in a range": (images(files(WORDS)), RANGE, "no distances for input.range"),
    "npy 16 bit in a range": (array(WORDS), RANGE, "no distances for input.range"),
    "mcap bayer": (raws(ramp(), "bayer_rggb8"), "", "two by two pixels of a Bayer pattern"),
    "mcap depth": (raws(WORDS, "16UC1"), "", "distances (16UC1) are read as gray"),
    "mcap floats": (raws(FLOATS, "32FC1"), "", "its images are distances"),
    "mcap no distance": (raws(FLOATS * np.nan, "32FC1"), RANGE, "without a distance become black"),
    "mcap exif": (packed(files(ramp(), "JPEG", exif=TURNED)), "", EXIF),
    "mcap topics": (mixed, "", LEFT_OUT + "/joints"),
    "mcap one topic": (mixed, "--topic /cam", ""),
    "mcap int64": (joints(2**53 + 1), "--field x", ROUNDED),
    "mcap lengths": (joints([1], [1, 2]), "--field x", "but the first had 1"),
    "mcap null": (joints(1.5, None), "--field x", "not finite"),
    "mcap null in a range": (joints(None, 1.5), f"--field x {RANGE}", "not finite become 1"),
    "bag topics": (bag(ramp(), "mono8"), "", LEFT_OUT + "/chatter"),
    "bag 16 bit": (bag(WORDS, "mono16"), "", HIGH),
    "lerobot features": (dataset, "", LEFT_OUT + "observation.joints"),
    "images colors": (images(files(ramp(3))), "", GRAY),
    "images alpha": (images(files(ramp(4))), "", ALPHA),
    "images 16 bit": (images(files(WORDS)), "", HIGH),
    "images later colors": (images([*files(ramp()), *files(ramp(3))]), "", GRAY),
    "images exif": (images(files(ramp(), "JPEG", exif=TURNED), "jpg"), "", EXIF),
    "images large": (images(files(LARGE)), "", ": 192x144, resized to"),
    "npy int64": (array(BIG), "", ROUNDED),
    "npz int64": (array(-BIG, "npz"), "", ROUNDED),
    "npy 16 bit": (array(WORDS), "", HIGH),
    "npy floats": (array(FLOATS), "", "floats of 0 to 1 are reduced to 8 bits"),
    "npy alpha": (array(ramp(4)), "", ALPHA),
    "npy null": (array(np.full((COUNT, 2), np.nan)), "", "rows have NaN or infinity"),
    "table int64": (table(a=BIG), "", ROUNDED),
    "table words": (table(a=range(COUNT), w=["x"] * COUNT), "", "are left out: w (string)"),
    "table null": (table(a=[1.5, None] * 15), "", "has no finite number"),
    "table null in a range": (table(a=[2.5, np.inf] * 15), RANGE, "not finite become 1"),
    "video colors": (video("yuv420p"), "", GRAY),
    "video 12 bit": (video("yuv420p12le"), "", "12-bit pixels are reduced to 8 bits"),
    "video tracks": (video("gray", 2), "", "it has 2 video tracks: only the first is read"),
}


@pytest.mark.parametrize("row", ROWS)
def test_a_reader_states_what_it_drops(row: str, tmp_path: Path, cdmisfa: Any) -> None:
    write, options, expected = ROWS[row]
    words = ["--rate", "50", *options.split(), "--json", "-o", tmp_path / "rec"]
    done = cdmisfa("convert", write(tmp_path), *words)
    assert done.code in (0, 2)
    lines = [*done.json["warnings"], *done.json["notes"]] if done.code == 0 else [done.err]
    assert any(expected in line for line in lines) if expected else not lines
    assert all(line in done.err for line in lines)
