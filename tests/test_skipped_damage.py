"""One broken image among many: refused with the remedy, or passed over with --skip-damaged."""

from __future__ import annotations

import random
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import HEIGHT, PACKED, RAW, WIDTH, packed, pictures, raw
from conftest import Cdmisfa
from folders import external, flip
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from message_files import START, STEP, every, learned_alike, write_mcap
from video_packets import COUNT, FOXGLOVE, GROUP, foxglove, video

from cdmisfa.core.errors import LogDamagedError

SIZE = (HEIGHT, WIDTH)


def write(path: Path, broken: Sequence[int], count: int = 40) -> Path:
    messages = [packed(image) for image in pictures(count)]
    for row in broken:
        image = CompressedImage.FromString(messages[row])
        image.data = image.data[:60]
        messages[row] = image.SerializeToString()
    return write_mcap(path, PACKED, {"/cam": every(STEP, messages)})


def write_video_messages(path: Path, packets: Sequence[bytes]) -> Path:
    messages = [foxglove(packet, "h264") for packet in packets]
    return write_mcap(path, FOXGLOVE, {"/cam": every(STEP, messages)})


def shown(path: Path, rows: Sequence[int]) -> list[np.ndarray[Any, Any]]:
    """The frames of a log whose damage is skipped, asked for in some order."""
    with external(path, size=SIZE, skip_damaged=True, loop=True) as source:
        frames = []
        for row in rows:
            source.seek(row)
            frames.append(source.take(0, 1).frames[0])
        return frames


def test_a_broken_image_is_refused_with_the_remedy_and_passed_over_with_it(tmp_path: Path) -> None:
    path, images = write(tmp_path / "a.mcap", [0, 7, 8, 39]), list(pictures(40))
    with pytest.raises(LogDamagedError, match=f"/cam at {START} ns.*broken.*with --skip-damaged"):
        external(path)
    stands_for = {0: 1, 7: 6, 8: 6, 39: 38}
    order = [*range(45), 8, 7, 39, 0, 1, 7]
    for row, frame in zip(order, shown(path, order), strict=True):
        np.testing.assert_array_equal(frame, images[stands_for.get(row % 40, row % 40)])
    with external(path, skip_damaged=True) as source:
        assert source.take(0, 8).frames.shape[0] == 8
        assert "2 of 40 images are broken" in source.skipped_damage()[0]
    with pytest.raises(LogDamagedError, match=r"/cam.*its PNG is cut short$"):
        external(write(tmp_path / "b.mcap", range(3), 3), skip_damaged=True)


def test_images_after_skipped_damage_are_learned_from_and_converted_alike(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    path = write(tmp_path / "a.mcap", [5, 25])
    assert cdmisfa("learn", path, "--max-iterations", "3", "--set", "learner.tau=10").code == 3
    for said in learned_alike(cdmisfa, tmp_path, path, "--skip-damaged")["said"]:
        assert "2 of 40 images are broken and replaced" in said


def test_a_video_is_shown_again_from_the_next_whole_picture(tmp_path: Path) -> None:
    packets = list(video("h264"))
    expected = shown(write_video_messages(tmp_path / "b.mcap", packets), range(COUNT))
    packets[15], packets[30] = packets[15][:-40] + bytes(40), b""
    path = write_video_messages(tmp_path / "a.mcap", packets)
    last = dict.fromkeys(range(15, 2 * GROUP), 14) | dict.fromkeys(range(30, 3 * GROUP), 29)
    order = [*range(COUNT), *random.Random(0).sample(range(COUNT), COUNT)]
    for row, frame in zip(order, shown(path, order), strict=True):
        np.testing.assert_array_equal(frame, expected[last.get(row, row)], err_msg=str(row))
    with external(path, size=SIZE) as source:
        source.seek(30)
        with pytest.raises(LogDamagedError, match="its message is empty, without an image"):
            source.take(0, 1)


def film(path: Path, packets: Sequence[bytes]) -> tuple[int, int]:
    """Write a film of packets of H.264; gives place and size of the one of frame 17."""
    import av

    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 4 * WIDTH, 4 * HEIGHT, "yuv420p"
        for i, data in enumerate(packets):
            packet = av.Packet(data)
            packet.stream, packet.pts, packet.dts = stream, i, i
            packet.time_base, packet.is_keyframe = Fraction(1, 20), i % GROUP == 0
            container.mux(packet)
    with av.open(str(path)) as container:
        made = [packet for packet in container.demux(video=0) if packet.size]
    return made[17].pos, made[17].size


def test_a_broken_film_shows_the_same_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    place, size = film(path, video("h264"))
    expected = shown(path, range(COUNT))
    data = bytearray(path.read_bytes())
    data[place + 5 : place + size] = bytes(size - 5)
    path.write_bytes(data)
    last = dict.fromkeys(range(17, 2 * GROUP), 16)
    order = [*range(COUNT), 3, 30, *random.Random(0).sample(range(COUNT), COUNT)]
    for row, frame in zip(order, shown(path, order), strict=True):
        np.testing.assert_array_equal(frame, expected[last.get(row, row)], err_msg=str(row))


def test_an_index_that_names_other_messages_is_damage_with_a_remedy(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", RAW, {"/cam": every(STEP, map(raw, pictures(40)))})
    time = (START + 3 * STEP).to_bytes(8, "little")
    flip(path, path.read_bytes().rfind(time))  # in the chunk's message index
    with (
        external(path) as source,
        pytest.raises(
            LogDamagedError, match=r"other messages than the summary states.*--skip-damaged"
        ),
    ):
        source.take(0, 8)
    for row, frame in enumerate(shown(path, range(8))):
        np.testing.assert_array_equal(frame, list(pictures(8))[row])
