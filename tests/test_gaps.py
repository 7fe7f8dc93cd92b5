"""Pauses of cameras are found, said, and never learned across; parts and sizes are as asked."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from camera_files import write_images
from conftest import Cdmisfa
from contracts.sources import SourceContract
from folders import contents, coverage, external

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import LogExhaustedError
from recorder.images.framing import FRAME_PIXELS, default_size
from recorder.images.options import Align
from recorder.recording import RecordingStoppedError, record, recorded
from replay.logs.clock import intersection
from replay.logs.source import LoggedSource
from replay.open_sources import open_recording

STEP_MS = 20
PAUSED = (*range(0, 2000, STEP_MS), *range(5000, 9000, STEP_MS))
"""Times of 100 images, a gap of three seconds, and 200 images, in milliseconds."""


def write_log(
    path: Path, times_ms: Sequence[int], shapes: Sequence[tuple[int, int]] = ((12, 16),)
) -> Path:
    """A log whose i-th image has the value i % 256 and the i-th shape, the last for the rest."""
    images = (
        (ms, np.full(shapes[min(i, len(shapes) - 1)], i % 256, np.uint8))
        for i, ms in enumerate(times_ms)
    )
    return write_images(path, {"/cam": images})


class TestWithoutGaps(SourceContract):
    ends = True

    @pytest.fixture(autouse=True)
    def _log(self, tmp_path: Path) -> None:
        self.path = write_log(tmp_path / "log.mcap", PAUSED)

    def open(self) -> FrameSource:
        return external(self.path, gaps="hold")


def values(source: LoggedSource, n: int) -> tuple[int, list[int]]:
    block = source.take(0, n)
    return block.t, block.frames[:, 0, 0].tolist()


@pytest.mark.parametrize("align", [None, "time"])
def test_no_block_reaches_across_a_gap(tmp_path: Path, align: Align | None) -> None:
    source = external(write_log(tmp_path / "log.mcap", PAUSED), align=align)
    assert (source.frames, source.pauses) == (450, {"cam": [(100, 250)]})
    assert values(source, 90) == (0, list(range(90)))
    assert values(source, 90) == (250, [i % 256 for i in range(100, 190)])
    assert source.spec.time_ns(250) == 5 * 10**9
    assert [(b.t, len(b)) for b in (source.seek(80), source.take_all(300))[1]] == [
        (80, 20),
        (250, 130),
    ]
    with pytest.raises(LogExhaustedError, match="without a gap"):
        source.take(0, 90)
    assert "a gap of 3 s after 1.98 s: no block spans a gap" in source.warnings[0]
    assert source.alignment["cam"] == {"messages": 300, "repeated": 0, "dropped": 0}


RATES = {
    "lost": ([*range(0, 4000, 20), *range(4080, 8000, 20)], "(4 missing): 8 s become 7.92 s"),
    "two rates": ([*range(0, 1000, 100), *range(1000, 1500, 25)], "(30 missing): 1.5 s become"),
    "slow": ([*range(0, 4000, 28), *range(4004, 9000, 20)], "(0 missing): 9.004 s become 7"),
    "even": (range(0, 4000, 20), ""),
    "jitter": ([20 * i + (0, 0, 0, 12, 0, 0, 0)[i % 7] for i in range(200)], ""),
    "a pause": (PAUSED, ""),
    "one": ([0, 20], ""),
}


@pytest.mark.parametrize(("times", "said"), RATES.values(), ids=RATES)
def test_images_at_other_times_than_their_frames_are_said(
    times: Sequence[int], said: str, tmp_path: Path
) -> None:
    path = write_log(tmp_path / "log.mcap", times)
    warnings = external(path).warnings
    if not said:
        assert not [line for line in warnings if "one image a frame" in line]
        return
    (line,) = warnings
    assert line.startswith(f"{path}: /cam is read one image a frame, at an uneven rate ")
    assert said in line
    remedy = line.split("--align time --rate ")[1].split()[0]
    remaining = external(path, align="time", rate=float(remedy))
    assert not remaining.warnings
    assert remaining.frames / remaining.spec.fps == pytest.approx(
        (times[-1] - times[0]) / 1000, abs=0.05
    )
    assert not external(path, align="index").warnings


def test_a_gap_comes_again_with_every_turn(tmp_path: Path) -> None:
    source = external(write_log(tmp_path / "log.mcap", PAUSED), loop=True)
    assert [values(source, 150)[0] for _ in range(4)] == [250, 400, 700, 850]
    with pytest.raises(LogExhaustedError, match="without a gap"):
        source.take(0, 500)


def test_held_gaps_show_the_last_image(tmp_path: Path) -> None:
    source = external(write_log(tmp_path / "log.mcap", PAUSED), gaps="hold")
    source.seek(90)
    assert values(source, 170) == (90, [*range(90, 100), *[99] * 150, *range(100, 110)])
    assert "the last image is repeated" in source.warnings[0]


def test_a_part_of_a_log_is_taken(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", range(0, 4000, STEP_MS))
    source = external(log, start=1.0, end=2.0)
    assert (source.frames, source.spec.start_ns) == (50, 10**9)
    assert values(source, 50) == (0, list(range(50, 100)))


def test_a_part_is_written_as_minutes_and_seconds(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    log, out = write_log(tmp_path / "log.mcap", PAUSED, [(240, 320)]), tmp_path / "run"
    words = ("learn", log, "-o", out, "--start", "1", "--end", "0:08", "--max-iterations", 1)
    done = cdmisfa(*words, "--no-rerun")
    assert done.code == 0
    assert "320x240, resized to 80x60" in done.err
    source = json.loads((out / "run.json").read_text())["source"]
    assert (source["frames"], source["rate"], source["size"]) == (350, 50.0, [60, 80])
    assert list(source["gaps"].values()) == [[[50, 200]]]
    assert cdmisfa("learn", log, "--start", "later").code == 2
    assert "has no images between --start" in cdmisfa("learn", log, "--start", "1:00").err


def test_a_run_across_a_gap_is_checked_and_resumed(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    log, run = write_log(tmp_path / "log.mcap", range(0, 20000, STEP_MS)), tmp_path / "run"
    paused = write_log(
        tmp_path / "paused.mcap", [t if t < 9000 else t + 97000 for t in range(0, 20000, STEP_MS)]
    )
    words = ["learn", paused, "--no-rerun", "--json", "-o"]
    whole = cdmisfa(*words, run, "--max-iterations", "12").json["signals_sha256"]
    part = tmp_path / "part"
    assert cdmisfa(*words, part, "--max-iterations", "5").code == 0
    resumed = cdmisfa("learn", "--resume", "-o", part, "--max-iterations", "12", "--json")
    assert resumed.json["signals_sha256"] == whole
    assert cdmisfa("check", run).code == 0
    other = cdmisfa("learn", log, "--json", "--max-iterations", "12").json["signals_sha256"]
    assert other != whole
    other = cdmisfa(*words, part, "--resume", "--align", "time", "--rate", "25")
    assert (other.code, "record.fps = 50.0, not 25.0" in other.err) == (2, True)


@pytest.mark.parametrize(
    ("gaps", "said", "frames", "held"),
    [
        ("skip", "no block spans a gap", 300, [(0, 100), (250, 450)]),
        ("hold", "the last image is repeated", 450, [(0, 450)]),
    ],
)
def test_a_conversion_keeps_its_clock_and_has_the_gaps_of_its_logs(
    cdmisfa: Cdmisfa, tmp_path: Path, gaps: str, said: str, frames: int, held: list[Any]
) -> None:
    log, rec = write_log(tmp_path / "log.mcap", PAUSED), tmp_path / "rec"
    done = cdmisfa("convert", log, "-o", rec, "--set", f"input.gaps={gaps}", "--json")
    assert said in done.err
    assert done.json["frames"] == frames
    assert coverage(rec) == {"cam": held}
    assert cdmisfa("verify", rec).code == 0
    options = ["--set", "learner.tau=30", "--json", "--max-iterations"]
    for words in (["8"], ["30", "--loop"]):
        logs = ([log, "--set", f"input.gaps={gaps}"], [rec])
        runs = [cdmisfa("learn", *named, *options, *words) for named in logs]
        assert [run.code for run in runs] == [0, 0]
        assert runs[0].json["signals_sha256"] == runs[1].json["signals_sha256"]


@pytest.mark.parametrize("split", [None, 2.0], ids=["one", "parts"])
def test_a_conversion_with_gaps_is_resumed(tmp_path: Path, split: float | None) -> None:
    left = write_log(tmp_path / "left.mcap", PAUSED)
    # its first image comes before the other's, its next long after, and it ends before the other
    right = write_log(tmp_path / "right.mcap", [400, *range(3000, 8000, STEP_MS), 12000])

    def converted(name: str, after: int, *, resume: bool = False) -> Path:
        reported: list[float] = []
        how = {"stop": lambda: len(reported) > after, "progress": reported.append}
        source = external([left, right], align="time", rate=50, start=0.4)
        with contextlib.closing(source), contextlib.suppress(RecordingStoppedError):
            record(source, tmp_path / name, split=split, resume=resume, **how)
        return tmp_path / name

    whole = converted("whole", 999)
    held = coverage(whole)
    assert sum(map(len, held.values())) > 2
    assert len({stretches[-1][1] for stretches in held.values()}) == 2
    frames = sum(high - low for stretches in held.values() for low, high in stretches)
    assert sum(view.frames for view in recorded(whole)) == frames
    for after in (0, 2, 5):
        part = converted(f"part{after}", after)
        assert list(part.glob("*.partial"))
        converted(part.name, 999, resume=True)
        for _ in range(2):
            assert contents(part) == contents(whole)
            converted(part.name, 999, resume=True)


def test_a_dataset_has_an_episode_between_gaps(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    left = write_log(tmp_path / "left.mcap", PAUSED)
    right = write_log(tmp_path / "right.mcap", [*range(0, 4000, STEP_MS), *range(5990, 9000, 20)])
    rec, out = tmp_path / "rec", tmp_path / "set"
    assert cdmisfa("convert", left, right, "--align", "time", "-o", rec).code == 0
    done = cdmisfa("export", rec, "--to", "lerobot", "--lossless", "-o", out)
    assert done.code == 0, done.err
    with open_recording(rec) as source:
        one, two = source.coverage().values()
        shared = intersection(one, two)
        assert len(shared) == 2
        assert shared not in (one, two)
        wanted = [[_frames(source, stream, *span) for span in shared] for stream in range(2)]
    lengths = [high - low for low, high in shared]
    rows = pq.read_table(out / "data" / "chunk-000" / "file-000.parquet").to_pydict()
    assert rows["episode_index"] == [0] * lengths[0] + [1] * lengths[1]
    assert rows["frame_index"] == [*range(lengths[0]), *range(lengths[1])]
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    keys = sorted(key.split("/")[1] for key in episodes[0] if key.endswith("/to_timestamp"))
    for key, own in zip(keys, wanted, strict=True):
        starts = [row[f"videos/{key}/from_timestamp"] for row in episodes]
        assert starts == [0, lengths[0] / 50]
        for row, frames in zip(episodes, own, strict=True):
            assert row[f"stats/{key}/mean"][0][0][0] == pytest.approx(frames.mean() / 255)
        with external(out, [key]) as source:
            read = [_frames(source, 0, *span) for span in source.spans(0, 0, source.frames)]
        for frames, again in zip(own, read, strict=True):
            assert np.abs(frames.astype(int) - again).max() <= 1


def _frames(source: Any, stream: int, low: int, high: int) -> np.ndarray:
    source.seek(low)
    return np.asarray(source.take(stream, high - low).frames)


@pytest.mark.parametrize(
    ("image", "frame"),
    [((48, 128), (48, 128)), ((240, 320), (60, 80)), ((480, 640), (60, 80)), ((12, 16), (12, 16))],
)
def test_a_frame_keeps_the_ratio_of_the_sides(
    image: tuple[int, int], frame: tuple[int, int]
) -> None:
    assert default_size(image) == frame
    assert frame[0] * frame[1] <= FRAME_PIXELS
