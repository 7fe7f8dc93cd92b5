"""Videos as others write them into messages, a picture each."""

from __future__ import annotations

import base64
import json
import os
import struct
from collections.abc import Callable
from functools import cache
from typing import Any

from camera_files import HEIGHT, WIDTH, pictures
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

from recorder.images.messages import MessageKind

COUNT, GROUP = 60, 12
FOXGLOVE = MessageKind("foxglove.CompressedVideo", "protobuf")
ENCODERS = {
    "h264": ("libx264", {"bf": "0", "preset": "ultrafast"}),
    "h265": ("libx265", {"preset": "ultrafast", "x265-params": "bframes=0:log-level=none"}),
    "vp9": ("libvpx-vp9", {"lag-in-frames": "0", "deadline": "realtime", "cpu-used": "8"}),
    "av1": ("libsvtav1", {"preset": "12", "svtav1-params": "pred-struct=1:lp=1"}),
}


OTHERS = {"h264 with B-frames": ("libx264", {"bf": "2", "preset": "veryfast"})}
"""Videos of which messages hold no picture each."""


@cache
def video(codec: str, seed: int = 0) -> tuple[bytes, ...]:
    """The packets of a video, one for each picture, of which every twelfth begins anew."""
    import av

    name, options = ENCODERS.get(codec) or OTHERS[codec]
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    encoder: Any = av.CodecContext.create(name, "w")
    encoder.width, encoder.height, encoder.pix_fmt = 4 * WIDTH, 4 * HEIGHT, "yuv420p"
    encoder.framerate, encoder.options = 25, {"g": str(GROUP), **options}
    packets = []
    for image in (*pictures(COUNT, seed), None):
        large = None if image is None else image.repeat(4, 0).repeat(4, 1)
        frame = None if large is None else av.VideoFrame.from_ndarray(large, format="gray")
        packets += [bytes(packet) for packet in encoder.encode(frame)]
    # SVT-AV1 gives the thread that calls it precedence over all else on the machine, where it may.
    os.sched_setscheduler(0, *before)
    return tuple(packets)


def foxglove(packet: bytes, codec: str) -> bytes:
    return CompressedVideo(data=packet, format=codec, frame_id="cam").SerializeToString()


def foxglove_json(packet: bytes, codec: str) -> bytes:
    return json.dumps({"data": base64.b64encode(packet).decode(), "format": codec}).encode()


def cdr(*parts: bytes | int) -> bytes:
    """Text, bytes and whole numbers after a stamp and "cam", aligned."""
    made = b"\0\1\0\0" + struct.pack("<iII", 5, 6, 4) + b"cam\0"
    for part in parts:
        made += bytes(-len(made) % 4)
        whole = isinstance(part, int)
        made += struct.pack("<I", part) if whole else struct.pack("<I", len(part)) + part
    return made


def ros2(packet: bytes, codec: str) -> bytes:
    return cdr(packet, codec.encode() + b"\0")


def ffmpeg_packet(packet: bytes, codec: str) -> bytes:
    head = cdr(4 * WIDTH, 4 * HEIGHT, f"{codec};yuv420p;bgr8".encode() + b"\0")
    head += bytes(-(len(head) - 4) % 8) + struct.pack("<QBB", 7, 0, 0)
    return head + bytes(-len(head) % 4) + struct.pack("<I", len(packet)) + packet


KINDS: dict[MessageKind, Callable[[bytes, str], bytes]] = {
    FOXGLOVE: foxglove,
    MessageKind("foxglove.CompressedVideo", "json"): foxglove_json,
    MessageKind("foxglove_msgs/msg/CompressedVideo", "cdr"): ros2,
    MessageKind("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "cdr"): ffmpeg_packet,
}
