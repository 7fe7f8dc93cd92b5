"""Own sources: iterables of frames, one time step after the other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from contracts.sources import ForwardContract

from cdmisfa import ArraySource, Recording, learn
from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError
from recorder.recording import record
from replay.open_sources import open_recording


class Robot:
    """Own source of two cameras, of which the second lacks some frames."""

    fps = 30

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for t, image in enumerate(np.random.default_rng(0).integers(0, 255, (130, 6, 8, 3))):
            yield {"left": image.astype(np.uint8), "right": None if t in GAPS else image}


GAPS = (0, 1, 50, 99, 129)


class TestOwnSource(ForwardContract):
    def open(self) -> FrameSource:
        return ArraySource([{**step, "right": step["left"]} for step in Robot()][:100])


@pytest.mark.filterwarnings("ignore:.* gaps, ")
def test_an_own_source_has_gaps_where_an_array_is_missing(tmp_path: Path) -> None:
    source = ArraySource(Robot())
    assert (source.spec.streams, source.spec.fps) == (("left", "right"), 30)
    blocks = source.take_all(130)
    parts = [(block.stream, block.t, len(block)) for block in blocks]
    assert parts == [(0, 0, 130), (1, 2, 48), (1, 51, 48), (1, 100, 29)]
    frames = Recording(np.stack([step["left"] for step in Robot()])).frames()
    for block in blocks:
        np.testing.assert_array_equal(block.frames, frames[block.t : block.t + len(block)])
    record(ArraySource(Robot()), tmp_path / "rec", frames=130)
    with open_recording(tmp_path / "rec") as recording:
        assert recording.spans(1, 0, 130) == [(2, 50), (51, 99), (100, 129)]
    run = learn(Robot(), max_iterations=2, tau=20)
    assert (run.streams, run.header.spec.fps) == (("left", "right"), 30)
    again = learn(tmp_path / "rec", max_iterations=2, tau=20, algorithm="progress")
    np.testing.assert_array_equal(run.signals["eta"], again.signals["eta"])


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([], "the first step has no frame: yield an array"),
        ([{"a": None}], "the first step has no frame"),
        ([np.zeros(3), np.zeros(4)], r"frame 1 of stream is float64 \(4,\): .*give \(n, 3\)"),
        ([{"a": 1.0}, {"b": 1.0}], "frame 1 is of a stream b, which the first step does not name"),
        ([np.zeros(3), np.ones(3, complex)], "frame 1 of stream is complex128"),
        ([np.array(["x"])], "frame 0 of stream is <U1"),
        (
            [{"a": np.zeros(3), "b": np.zeros((4, 4))}, {"b": np.zeros(4)}],
            r"frame 1 of b is float64 \(4,\)",
        ),
        ([np.zeros((4, 4)), np.full((4, 4), 9.0)], "frame 1 of stream is .* floats of 0 to 1"),
        ([np.ma.array([1, 2], mask=[0, 1])], "stream: some values are masked"),
        ([scipy.sparse.eye(3).tocsr()], "stream: the array is sparse: give it as x.toarray()"),
    ],
)
def test_a_wrong_frame_of_an_own_source_is_named(steps: list[Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        learn(iter(steps))
    with pytest.raises(UsageError, match=message):
        ArraySource(steps).take_all(2)


@pytest.mark.filterwarnings("ignore:.*are reduced to 8 bits")
@pytest.mark.parametrize("kind", ["f4", "i2", "u1", "?", "f8"])
def test_an_iterator_and_an_array_give_the_same_run(kind: str) -> None:
    for shape in ((400, 3), (400,), (400, 6, 8), (400, 6, 8, 3)):
        whole = (np.random.default_rng(0).random(shape) * (1 if "f" in kind else 99)).astype(kind)
        runs = [learn(x, max_iterations=5, tau=20).signals for x in (whole, iter(whole))]
        np.testing.assert_array_equal(runs[0]["y"], runs[1]["y"])
