"""What a program or a notebook does: `learn` from anything, and what it holds then."""

from __future__ import annotations

import copy
import gc
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import scipy.sparse
from conftest import Cdmisfa
from contracts.sources import SourceContract

import cdmisfa
from cdmisfa import Recording, Run, learn
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.experiments.resume import check_run
from recorder.images.options import InputOptions
from replay.logs.source import LoggedSource
from replay.open_sources import open_arrays

ROOT = Path(__file__).parents[1]
FEW: dict[str, Any] = {"max_iterations": 12, "tau": 20}


def numbers(rows: int = 400) -> Any:
    t = np.arange(rows) / 20
    return np.stack([np.sin(t), np.cos(3 * t), np.sin(7 * t)], axis=1)


def pictures(*shape: int) -> Any:
    return np.random.default_rng(0).integers(0, 255, (400, *shape), np.uint8)


class Table:
    """What stands for a DataFrame."""

    def to_numpy(self) -> Any:
        return numbers().astype(np.float32)


class TestArrays(SourceContract):
    ends = True

    def open(self) -> LoggedSource:
        rows = pictures(8, 12, 3)[:100]
        return open_arrays({"left": rows, "right": 255 - rows}, InputOptions(size=(4, 6), rate=10))


class TestNumbers(SourceContract):
    ends = True

    def open(self) -> LoggedSource:
        return open_arrays({"all": numbers(60)})


@pytest.mark.filterwarnings("ignore:.*(bits|byte|transparency)")
@pytest.mark.parametrize(
    ("given", "shape", "dtype"),
    [
        (numbers()[:, 0], (1,), "float64"),
        (list(range(400)), (1,), "float64"),
        ((100 * numbers()).astype(np.int16), (3,), "float64"),
        (numbers() > 0, (3,), "float64"),
        (Table(), (3,), "float64"),
        (pa.table({"a": numbers()[:, 0], "b": range(400)}), (2,), "float64"),
        (pictures(6, 8), (6, 8), "uint8"),
        (pictures(6, 8, 3), (6, 8), "uint8"),
        (pictures(6, 8, 4), (6, 8), "uint8"),
        (pictures(6, 8).astype(np.uint16) << 8, (6, 8), "uint8"),
        (pictures(6, 8) / 255, (6, 8), "uint8"),
        (pictures(6, 8) > 99, (6, 8), "uint8"),
        ({"a": numbers(), "b": numbers()[::-1]}, (3,), "float64"),
        ({"made": (row for row in numbers())}, (3,), "float64"),
    ],
)
def test_arrays_of_any_type_are_learned_from(given: Any, shape: Any, dtype: str) -> None:
    run = learn(given, **FEW)
    spec = run.header.spec
    assert (spec.frame_shape, spec.dtype) == (shape, dtype)
    assert run.frames().shape == (240 if dtype == "float64" else 24, *shape)
    assert run.signals.to_arrow().num_rows == 12


def test_pictures_of_any_type_are_the_same_frames() -> None:
    gray = pictures(6, 8)
    for same in (
        gray.astype(">u2") << 8,
        gray / 255,
        gray.astype(int),
        gray.astype(np.uint16) << 8,
        gray[..., None],
    ):
        assert np.array_equal(Recording(same).frames(), gray)
    assert np.array_equal(Recording(np.stack([gray] * 3, axis=3)).frames(), gray)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            [[1.0, 2.0], [3.0, np.nan]],
            "stream: 1 of 2 rows have NaN or infinity, the first is row 1",
        ),
        (
            {"cam": np.zeros((9, 3, 20, 30))},
            r"cam: .* np.moveaxis\(x, 1, -1\) moves the colors to the end",
        ),
        (1000 * numbers().reshape(-1, 4, 5), "scale them to 0 to 1"),
        ({"a": scipy.sparse.eye(400)}, "a: the array is sparse: give it as x.toarray"),
        (["one", 2], "shape .* of <U21 is not supported: use"),
        (np.zeros((0, 3)), "shape .0, 3. of float64 is not supported: use"),
        ("nowhere.npz", "no such file"),
        (numbers()[:10], "10 frames are left at frame 0, but a block has 40"),
    ],
)
def test_what_cannot_be_learned_from_is_one_line(
    given: Any, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(CdmisfaError, match=said) as result:
        learn(given)
    assert "\n" not in str(result.value)
    assert list(tmp_path.iterdir()) == []


def test_files_of_arrays_are_logs_that_runs_find_again(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    arrays = {"a": numbers(), "b": numbers()[::-1]}
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    np.save(tmp_path / "y.npy", arrays["a"])
    held, run = learn(arrays, **FEW), learn(str(tmp_path / "x.npz"), tmp_path / "run", **FEW)
    assert dict(run.result or {})["signals_sha256"] == dict(held.result or {})["signals_sha256"]
    assert check_run(run.path).holds
    assert run.at(7).iteration == held.at(7).iteration == 7
    other = cdmisfa("learn", tmp_path / "y.npy", "-o", tmp_path / "other", "--max-iterations", "3")
    assert other.code == 0, other.err
    assert Run(tmp_path / "other").streams == ("y",)
    np.savez(tmp_path / "x.npz", **(arrays | {"a": arrays["b"]}))
    assert check_run(run.path).other_files == ("x.npz",)


def test_a_run_gives_what_its_log_holds(tmp_path: Path) -> None:
    rewards: list[float] = []

    class Rewards(cdmisfa.Sink):
        def block(self, block: Any, signals: Any, learner: Any) -> None:
            rewards.append(signals.reward)

    learn("oscillatory", tmp_path / "run", max_modules=1, sinks=[Rewards()])
    again = Run(tmp_path / "run")
    assert again.signals["reward"].tolist() == pytest.approx(rewards, nan_ok=True)
    for ask in (again.signals.__getitem__, again.signals.to_arrow):
        with pytest.raises(
            UsageError, match=r"^no signal 'rewards': did you mean reward"
        ) as result:
            ask("rewards")
        assert isinstance(result.value, KeyError)
    assert "rewards" not in again.signals
    table = again.signals.to_arrow("iteration", "reward", "eta")
    assert table.num_rows == len(rewards)
    assert table["reward"].null_count == np.isnan(rewards).sum()
    assert again.config["learner"]["tau"] == again.signals["y"].shape[1]
    assert again.events[-1].text.startswith("ended: ")
    (module,) = again.modules
    shown = module.transform(again.frames(0, 3))
    assert np.array_equal(again.modules[0].transform(again.frames(0, 3)), shown)
    assert "1 module learned" in again.summary()
    for part in ((3, 3), (-1, 2), (0, 10**6)):
        with pytest.raises(ValueError, match="no iterations"):
            again.frames(*part)
    again.view(tmp_path / "view.rrd")
    assert (tmp_path / "view.rrd").stat().st_size > 0


def test_parts_of_a_temporary_run_outlive_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    kept = learn(numbers(), tmp_path / "kept", **FEW)
    for use in (
        lambda run: run.signals.to_arrow().equals(kept.signals.to_arrow()),
        lambda run: len(list(run.signals.values())),
        lambda run: iter(run.signals.items()),
        lambda run: run.signals["y"],
        lambda run: run.modules,
        lambda run: run.events,
        lambda run: run.frames,
        lambda run: run.frames(0, 2).shape == kept.frames(0, 2).shape,
        lambda run: run.at(3).iteration == 3,
        lambda run: run.report,
        lambda run: copy.copy(run.signals).to_arrow,
        lambda run: copy.deepcopy(run).signals.to_arrow,
        lambda run: copy.deepcopy(run).frames,
    ):
        part = use(learn(numbers(), **FEW))
        gc.collect()
        assert part() is not None if callable(part) else part is not False
        if hasattr(part, "__next__"):
            assert len(list(part)) == len(kept.signals)
    signals = learn(numbers(), **FEW).signals
    gc.collect()
    assert signals.to_arrow().equals(kept.signals.to_arrow())
    del signals, part
    gc.collect()
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


class Press(cdmisfa.Sink):
    """Presses Ctrl-C at an iteration."""

    def __init__(self, at: int = 3, times: int = 1) -> None:
        self.at, self.times = at, times

    def block(self, block: Any, signals: Any, learner: Any) -> None:
        if signals.iteration == self.at:
            for _ in range(self.times):
                os.kill(os.getpid(), signal.SIGINT)
                signal.sigpending()  # Python runs the handler between two bytecodes


@pytest.fixture
def default_handler() -> Iterator[None]:
    """Handle Ctrl-C as Python does; a process started in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("default_handler")
def test_ctrl_c_saves_the_run_and_raises(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", numbers(2000))
    source, folder = str(tmp_path / "x.npy"), tmp_path / "run"
    whole = learn(source, tmp_path / "whole", max_iterations=20, tau=20)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match=r"the run is saved: .*run"):
        learn(source, folder, max_iterations=20, tau=20, sinks=[Press()])
    assert signal.getsignal(signal.SIGINT) is before
    run = Run(folder)
    assert run.signals["iteration"].tolist() == [0, 1, 2, 3]
    assert run.events[-1].text.startswith("ended: it was interrupted")
    assert cdmisfa("learn", "--resume", "-o", folder).code == 0
    assert (
        dict(Run(folder).result or {})["signals_sha256"]
        == dict(whole.result or {})["signals_sha256"]
    )
    with pytest.raises(KeyboardInterrupt, match="twice is not finished: continue with --resume"):
        learn(source, tmp_path / "twice", max_iterations=20, tau=20, sinks=[Press(times=2)])
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_is_the_callers_if_it_has_a_handler_or_learns_in_a_thread() -> None:
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        assert len(learn(numbers(), **FEW, sinks=[Press()]).signals["iteration"]) == 12
    finally:
        signal.signal(signal.SIGINT, before)
    assert pressed == [signal.SIGINT]
    runs: list[Run] = []
    thread = threading.Thread(target=lambda: runs.append(learn(numbers(), **FEW)))
    thread.start()
    thread.join()
    assert len(runs[0].signals["iteration"]) == 12


def test_a_recording_gives_the_frames_of_its_streams() -> None:
    recording = Recording(ROOT / "sample_logs" / "icub", topics=["/view/left", "/view/right"])
    assert recording.spec.streams == ("left", "right")
    left = recording.frames("left", 5, 25)
    with recording.source() as source:
        source.seek(5)
        assert np.array_equal(source.take(0, 20).frames, left)
    assert learn(recording, max_iterations=2).header.spec.streams == ("left", "right")
    with pytest.raises(ValueError, match="no stream 'up': there are left, right"):
        recording.frames("up")
    with pytest.raises(ValueError, match="no frames"):
        recording.frames("left", 5, 10**9)
    with pytest.raises(UsageError, match="did you mean topics"):
        Recording("x.mcap", topic=["/a"])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"a": numbers(), "b": numbers(300)}, r"\(a has 400, b has 300\): only 300 rows of each"),
        (pictures(6, 8, 4), "stream: transparency is ignored"),
        (pictures(6, 8).astype(np.uint16), "16-bit pixels are reduced to their high byte"),
    ],
)
def test_what_a_source_drops_is_a_warning_at_the_callers_line(given: Any, said: str) -> None:
    with pytest.warns(UserWarning, match=said) as lines:
        learn(given, **FEW)
    assert [line.filename for line in lines] == [__file__]


@pytest.mark.parametrize("given", [numbers(), pictures(6, 8), {"<b>": numbers()}])
def test_representations_are_one_short_line(given: Any) -> None:
    for described in (Recording(given), learn(given, **FEW)):
        text = repr(described)
        assert len(text) < 200
        assert "\n" not in text
    assert len(repr(learn(given, **FEW).signals)) < 500


@pytest.mark.filterwarnings("ignore:.*(bits|byte|transparency)")
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float64])
def test_modules_take_the_pictures_that_they_learned_from(kind: Any) -> None:
    t = np.arange(3000)
    drift = 128 + 100 * np.sin(t / 60)[:, None, None] * np.linspace(0, 1, 40)[None, :, None]
    shown = (drift + np.zeros((1, 1, 60))).astype(np.uint8)
    given = {np.uint8: shown, np.uint16: shown.astype(np.uint16) << 8, np.float64: shown / 255}[
        kind
    ]
    recording = Recording(given, size=(20, 30))
    run = learn(recording)
    (module, *_) = run.modules
    frames = recording.frames()
    assert frames.shape == (3000, 20, 30)
    assert np.array_equal(module.transform(given[:90]), module.transform(frames[:90]))
