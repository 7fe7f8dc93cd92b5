"""Recordings: the same bytes however they are made, readable by others, safe from any end."""

import errno
import hashlib
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from folders import contents
from foxglove_schemas_protobuf import RawImage_pb2
from mcap.reader import make_reader
from waiting import running, started, wait_for

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.config import RecordConfig
from recorder.log.files import RECORDING, partial_path
from recorder.log.manifest import RecordingStart, read_start, store_start
from recorder.log.resume import stored_frames
from recorder.recording import RecordingStoppedError, record_scene
from recorder.world.icub.config import IcubConfig
from recorder.world.scenes import SCENES, open_scene

ROOT = Path(__file__).parent.parent
STREAMS = ("x1", "x2", "x3")


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def whole_frames(path: Path, view: str) -> int:
    return stored_frames(path, view).stop_from(0)


@pytest.fixture(scope="module")
def oscillatory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "oscillatory"
    record_scene("oscillatory", folder, frames=3000)
    return folder


@pytest.fixture(scope="module")
def icub(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("pybullet")
    folder = tmp_path_factory.mktemp("whole") / "icub"
    record_scene("icub", folder, IcubConfig(seed=3), frames=150)
    return folder


def test_every_view_of_every_frame_is_there_and_equals_live(icub):
    live = open_scene("icub", IcubConfig(seed=3))
    for stream, view in enumerate(live.spec.streams):
        live.seek(0)
        block = live.take(stream, 150)
        with (icub / f"{view}.mcap").open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            topics = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
            assert {topic: schema.name for topic, schema in topics.items()} == {
                f"/view/{view}": "foxglove.RawImage",
                "/truth": "cdmisfa.GroundTruth",
                "/head_pose": "foxglove.PoseInFrame",
                f"/calibration/{view}/left_eye": "foxglove.CameraCalibration",
                f"/calibration/{view}/right_eye": "foxglove.CameraCalibration",
                "/tf": "foxglove.FrameTransforms",
                "/scene": "foxglove.SceneUpdate",
            }
            messages = list(reader.iter_messages(topics=[f"/view/{view}"]))
            images = [RawImage_pb2.RawImage.FromString(m.data) for _, _, m in messages]
            pixels = [np.frombuffer(i.data, np.uint8).reshape(i.height, i.width) for i in images]
            np.testing.assert_array_equal(np.stack(pixels), block.frames)
            assert [m.log_time for _, _, m in messages] == [
                live.spec.time_ns(t) for t in range(150)
            ]
            assert [m.sequence for _, _, m in messages] == list(range(150))
            assert len(list(reader.iter_messages(topics=["/head_pose"]))) == 3
            assert len(list(reader.iter_messages(topics=["/truth"]))) == 150
    live.close()


@pytest.mark.parametrize("kind", ["icub", "oscillatory"])
def test_bytes_do_not_depend_on_jobs(kind, request, tmp_path):
    whole = request.getfixturevalue(kind)
    seed, frames = (3, 150) if kind == "icub" else (0, 3000)
    record_scene(kind, tmp_path / "b", SCENES[kind].config(seed=seed), frames=frames, jobs=2)
    assert contents(tmp_path / "b") == contents(whole)


def test_one_view_alone_is_the_same_file(icub, tmp_path):
    (file,) = record_scene("icub", tmp_path, IcubConfig(seed=3), frames=150, views=["right"])
    data = (icub / "right.mcap").read_bytes()
    assert contents(tmp_path) == {"right.mcap": data}
    assert (file.name, file.sha256, file.bytes) == ("right", sha256(icub / "right.mcap"), len(data))


def test_an_existing_folder_is_kept_unless_forced(oscillatory, tmp_path):
    folder = tmp_path / "a"
    record_scene("oscillatory", folder, frames=10)
    (folder / "notes.txt").write_text("mine")
    before = contents(folder)
    with pytest.raises(UsageError, match=r"a exists.*--force"):
        record_scene("oscillatory", folder, frames=3000)
    assert contents(folder) == before
    record_scene("oscillatory", folder, frames=3000, views=["x2"], force=True)
    assert contents(folder) == {**before, "x2.mcap": (oscillatory / "x2.mcap").read_bytes()}


RECORD = """
import sys
from pathlib import Path
from cdmisfa.core.interrupts import stoppable
from recorder.recording import RecordingStoppedError, record, record_scene
if __name__ == "__main__":
    with stoppable() as stop:
        try:
            record_scene("oscillatory", Path(sys.argv[1]), frames=int(sys.argv[2]), stop=stop,
                         progress=lambda t: print(int(t), flush=True))
        except RecordingStoppedError as error:
            sys.exit(stop.exit_code)
"""


def interrupt(folder: Path, number: int) -> tuple[int, int]:
    """Record in another process and send it a signal; its exit code and last progress."""
    with running("-c", RECORD, folder, 1000000) as process:
        for line in process.stdout:
            if int(line) > 500:
                break
        process.send_signal(number)
        rest, _ = process.communicate(timeout=30)
    return process.returncode, int(([line, *rest.splitlines()])[-1])


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_what_a_signal_leaves_is_resumed_to_the_same_bytes(oscillatory, tmp_path, number):
    folder = tmp_path / "a"
    code, reported = interrupt(folder, number)
    killed = number == signal.SIGKILL
    assert code == (-number if killed else 128 + number)
    assert not list(folder.glob("*.mcap"))
    for view in STREAMS:  # of a kill at most a second is lost
        held = whole_frames(partial_path(folder / f"{view}.mcap"), view)
        assert held >= reported - (50 if killed else 0)
    noted = json.loads((folder / RECORDING).read_text())
    assert noted["frames"] == dict.fromkeys(STREAMS, 1000000)
    files = record_scene("oscillatory", folder, frames=3000, resume=True)
    assert [f.frames for f in files] == [3000] * 3
    assert contents(folder) == contents(oscillatory)


def test_a_stopped_recording_knows_how_long_it_was_to_be(oscillatory, tmp_path):
    folder, reported = tmp_path / "a", []
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]

    def stop() -> bool:
        assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before
        return len(reported) in (9, 20)

    why = "a is not finished: continue with --resume"
    with pytest.raises(RecordingStoppedError, match=why):
        record_scene("oscillatory", folder, frames=3000, progress=reported.append, stop=stop)
    left = [whole_frames(partial_path(folder / f"{view}.mcap"), view) for view in STREAMS]
    assert left == [192] * 3
    options = {"views": ["x2"], "progress": reported.append, "stop": stop}
    with pytest.raises(RecordingStoppedError, match=why):
        record_scene("oscillatory", folder, resume=True, **options)
    record_scene("oscillatory", folder, resume=True, progress=reported.append)
    assert reported[-1] == 3000
    assert contents(folder) == contents(oscillatory)


@pytest.mark.parametrize("split", [None, 3.0])
def test_a_complete_recording_is_left_as_it_is(tmp_path, split):
    folder, reported = tmp_path / "a", []
    first = record_scene("oscillatory", folder, frames=400, split=split)
    before = {path.name: path.stat().st_ino for path in folder.iterdir()}
    again = {"split": split, "resume": True, "progress": reported.append}
    assert record_scene("oscillatory", folder, frames=400, **again) == first
    assert record_scene("oscillatory", folder, **again) == first
    assert reported == []
    assert {path.name: path.stat().st_ino for path in folder.iterdir()} == before
    first[-1].file.rename(partial_path(first[-1].file))
    assert record_scene("oscillatory", folder, frames=400, **again) == first
    assert first[0].file.stat().st_ino == before[first[0].file.name]


@pytest.mark.parametrize("cut", [0.0, 0.001, 0.37, 0.999, 1.0])
def test_resume_goes_on_from_any_torn_byte(oscillatory, tmp_path, cut):
    for view in STREAMS[:2]:
        data = (oscillatory / f"{view}.mcap").read_bytes()
        partial_path(tmp_path / f"{view}.mcap").write_bytes(data[: int(cut * len(data))])
    record_scene("oscillatory", tmp_path, frames=3000, resume=True)
    assert contents(tmp_path) == contents(oscillatory)


@pytest.mark.parametrize("damage", [b"\xff" * 2000, bytes(10**6)])
def test_resume_takes_what_stands_before_the_first_damage(oscillatory, tmp_path, damage):
    path = partial_path(tmp_path / "x1.mcap")
    data = (oscillatory / "x1.mcap").read_bytes()
    middle = len(data) // 2
    path.write_bytes((data[:middle] + damage + data[middle + len(damage) :])[: len(data)])
    assert 1000 < whole_frames(path, "x1") < 2000
    record_scene("oscillatory", tmp_path, frames=3000, resume=True)
    assert contents(tmp_path) == contents(oscillatory)


def test_an_error_of_the_disk_while_resuming_costs_no_frame(tmp_path, monkeypatch):
    record_scene("oscillatory", tmp_path / "a", frames=3000)
    (tmp_path / "a" / "x1.mcap").rename(tmp_path / "a" / "x1.mcap.partial")
    before, left = contents(tmp_path / "a"), iter(range(7))

    def failing(read):
        def fails(*args):
            if next(left, None) is None:
                raise OSError(errno.EIO, "Input/output error")
            return read(*args)

        return fails

    for name in ("pread", "preadv"):
        monkeypatch.setattr(os, name, failing(getattr(os, name)))
    with pytest.raises(LogDamagedError, match="Input/output error"):
        record_scene("oscillatory", tmp_path / "a", frames=3100, resume=True)
    monkeypatch.undo()
    assert contents(tmp_path / "a") == before


def test_a_finished_recording_is_made_longer_and_never_shorter(oscillatory, tmp_path):
    record_scene("oscillatory", tmp_path / "a", frames=130)
    before = contents(tmp_path / "a")
    with pytest.raises(UsageError, match="has 130 frames, more than --frames 20"):
        record_scene("oscillatory", tmp_path / "a", frames=20, resume=True)
    assert contents(tmp_path / "a") == before
    record_scene("oscillatory", tmp_path / "a", frames=3000, resume=True)
    assert contents(tmp_path / "a") == contents(oscillatory)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"views": ["left"]}, "no view 'left': name one of x1, x2, x3"),
        ({"force": True, "resume": True}, "leave out --force"),
        ({"settings": RecordConfig(fps=25)}, r"x3\.mcap cannot be resumed: its fps is '50\.0'"),
        ({}, r"x2\.mcap exists, but frame 0 of x2"),
    ],
)
def test_what_cannot_be_resumed_is_named_and_nothing_changes(tmp_path, options, words):
    folder = tmp_path / "a"
    record_scene("oscillatory", folder, frames=130)
    (folder / "x1.mcap").unlink()
    (folder / "x2.mcap").unlink()
    if not options:
        (folder / "x2.mcap").write_bytes(b"precious")
    before = contents(folder)
    with pytest.raises(UsageError, match=words):
        record_scene("oscillatory", folder, **({"frames": 200, "resume": True} | options))
    assert contents(folder) == before


@pytest.fixture
def recorder(tmp_path):
    """A recording by two processes that does not end by itself, and they."""
    folder = tmp_path / "a"
    words = ("record", "oscillatory", "-o", folder, "--frames", 100000000, "--jobs", 2)
    with started(*words) as process:
        wait_for(
            lambda: sum(p.stat().st_size for p in folder.glob("*.partial")) >= 1 << 17, 60, process
        )
        commands = {n: Path(f"/proc/{n}/cmdline").read_text() for n in children(process)}
        yield process, [pid for pid, command in commands.items() if "popen_loky" in command]


def test_a_killed_rendering_process_ends_the_recording_with_one_line(recorder, tmp_path):
    process, workers = recorder
    os.kill(workers[1], signal.SIGKILL)
    _, complaint = process.communicate(timeout=10)
    assert process.returncode == 1
    (line,) = complaint.strip().splitlines()
    assert line.startswith("cdmisfa: a rendering process died: continue with --resume")
    assert not any(alive(pid) for pid in workers)
    for view in STREAMS:
        assert whole_frames(tmp_path / "a" / f"{view}.mcap.partial", view) > 0


def test_rendering_processes_end_with_their_killed_parent(recorder):
    process, _ = recorder
    rendering = children(process)
    assert len(rendering) >= 2
    process.kill()
    process.communicate()
    wait_for(lambda: not any(alive(child) for child in rendering), 20)


def children(process):
    """The processes that any thread of a process started."""
    listed = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [int(word) for path in listed for word in path.read_text().split()]


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_the_sample_logs_are_what_their_card_says():
    folder = ROOT / "sample_logs"
    card = (folder / "README.md").read_text()
    logs = sorted(folder.glob("*/*.mcap"))
    assert len(logs) == 6
    assert sum(log.stat().st_size for log in logs) < 3_000_000
    for log in logs:
        name = log.relative_to(folder).as_posix()
        assert f"| `{name}` | {log.stat().st_size:,} | `{sha256(log)}` |" in card
    assert "CC BY-SA 4.0" in card


def test_a_recording_stores_what_its_unfinished_views_shall_be(tmp_path: Path) -> None:
    first = RecordingStart("icub", 1, {"a": 5, "b": 5}, {"a": 5.0, "b": 5.0})
    store_start(tmp_path, ["a", "b"], first)
    store_start(tmp_path, ["a"], RecordingStart("icub", 1, {"a": 9}))
    assert read_start(tmp_path) == RecordingStart("icub", 1, {"a": 9, "b": 5}, {"b": 5.0})
    store_start(tmp_path, ["a"])
    assert read_start(tmp_path).frames == {"b": 5}
    store_start(tmp_path, ["b"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "noted",
    [
        "{",
        "[]",
        "7",
        '{"frames": 3}',
        '{"frames": {"a": true, "b": -1, "c": "x"}, "split": {"a": 3}, "scene": 4, "seed": -1}',
        '{"frames": {}, "seed": 1e300}',
    ],
)
def test_what_makes_no_sense_in_it_is_passed_over(tmp_path: Path, noted: str) -> None:
    (tmp_path / RECORDING).write_text(noted)
    assert read_start(tmp_path) == RecordingStart()
