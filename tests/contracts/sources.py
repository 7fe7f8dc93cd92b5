"""What every `FrameSource` and every `Camera` promise, as tests: say what to open.

`ForwardContract` is for all sources, `SourceContract` for those that can go back, too:

    class TestOscillatory(SourceContract):
        def open(self) -> SeekableSource:
            return OscillatorySource()

    class TestMine(CameraContract):
        def open(self) -> Camera:
            return MyCamera("mine:0", "mine")
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Iterator

import numpy as np
import pytest

from cdmisfa.core.blocks import Block, FrameSource, SeekableSource
from cdmisfa.core.errors import LogExhaustedError
from recorder.cameras.readers import Camera


def same(a: Block, b: Block) -> None:
    """Two blocks are equal to the bit."""
    assert (a.stream, a.t) == (b.stream, b.t)
    assert a.frames.dtype == b.frames.dtype
    np.testing.assert_array_equal(a.frames, b.frames)
    assert a.truth.tobytes() == b.truth.tobytes()


class ForwardContract:
    """What all sources promise; a subclass opens a fresh source, at frame 0, in `open`.

    Attributes:
        long: frames that some tests take from one source.
        ends: the source has a length and refuses to go beyond it.
    """

    long = 40
    ends = False

    def open(self) -> FrameSource:
        """Open a fresh source of the kind under test."""
        raise NotImplementedError

    @pytest.fixture
    def source(self) -> Iterator[FrameSource]:
        """A fresh source, closed afterwards; closing twice is harmless."""
        source = self.open()
        yield source
        source.close()
        source.close()

    @contextlib.contextmanager
    def another(self, t: int = 0) -> Iterator[FrameSource]:
        """Another source of the same kind, at frame t."""
        with contextlib.closing(self.open()) as other:
            if t:
                other.take(0, t)
            yield other

    def test_it_is_a_frame_source_at_frame_zero(self, source: FrameSource) -> None:
        assert isinstance(source, FrameSource)
        assert source.t == 0
        assert len(source.spec.streams) >= 1
        assert len(set(source.spec.streams)) == len(source.spec.streams)
        described = dict(source.describe())
        assert described["kind"]
        assert json.loads(json.dumps(described)) == described

    def test_blocks_are_as_the_spec_says(self, source: FrameSource) -> None:
        spec = source.spec
        block = source.take(len(spec.streams) - 1, 5)
        assert (block.stream, block.t, len(block)) == (len(spec.streams) - 1, 0, 5)
        assert block.frames.shape == (5, *spec.frame_shape)
        assert block.frames.dtype == np.dtype(spec.dtype)
        assert block.frames.flags.c_contiguous
        assert block.truth.shape == (5, len(spec.truth))
        assert block.truth.dtype == np.float64

    def test_the_clock_runs_with_the_frames(self, source: FrameSource) -> None:
        for n, t in ((3, 3), (4, 7), (1, 8)):
            assert source.take(0, n).t == t - n
            assert source.t == t
        spec = source.spec
        assert spec.time_ns(0) == spec.start_ns
        assert spec.time_ns(3) == spec.start_ns + round(3e9 / spec.fps)

    def test_frames_do_not_depend_on_how_they_are_cut(self, source: FrameSource) -> None:
        parts = (self.long * 3 // 8, self.long - self.long * 3 // 8)
        cut = [source.take(0, n) for n in parts]
        with self.another() as other:
            whole = other.take(0, self.long)
        np.testing.assert_array_equal(np.concatenate([b.frames for b in cut]), whole.frames)
        np.testing.assert_array_equal(np.concatenate([b.truth for b in cut]), whole.truth)

    def test_which_stream_is_watched_changes_nothing(self, source: FrameSource) -> None:
        last, head = len(source.spec.streams) - 1, self.long // 2
        with self.another() as other:
            for stream in range(last + 1):
                same(source.take(stream, 3), other.take(stream, 3))
            truth = source.take(last, head).truth
            np.testing.assert_array_equal(truth, other.take(0, head).truth)
            rest = self.long - other.t
            if rest > 0:
                same(source.take(0, rest), other.take(0, rest))

    def test_a_block_is_read_only_and_never_written_again(self, source: FrameSource) -> None:
        block = source.take(0, 10)
        with pytest.raises(ValueError, match="read-only"):
            block.frames[0] = 0
        with pytest.raises(ValueError, match="read-only"):
            block.truth[:] = 0
        frames, truth = block.frames.copy(), block.truth.copy()
        later = source.take(0, 10)
        assert not np.shares_memory(block.truth, later.truth) or not later.truth.size
        np.testing.assert_array_equal(block.frames, frames)
        np.testing.assert_array_equal(block.truth, truth)

    def test_all_streams_together_are_each_of_them(self, source: FrameSource) -> None:
        source.take(0, 5)
        for n in (7, 1):
            start = source.t
            blocks = source.take_all(n)
            assert source.t == start + n
            assert [block.stream for block in blocks] == list(range(len(source.spec.streams)))
            for block in blocks:
                with self.another(start) as other:
                    same(block, other.take(block.stream, n))
                with pytest.raises(ValueError, match="read-only"):
                    block.frames[0] = 0

    def test_what_is_no_block_is_refused(self, source: FrameSource) -> None:
        for n in (0, -3):
            with pytest.raises(ValueError, match="at least one frame"):
                source.take(0, n)
            with pytest.raises(ValueError, match="at least one frame"):
                source.take_all(n)
        for stream in (-1, len(source.spec.streams)):
            with pytest.raises(ValueError, match=f"stream {stream} does not exist"):
                source.take(stream, 3)
        assert source.t == 0

    def test_the_end_is_an_error_and_the_clock_stays(self, source: FrameSource) -> None:
        length = source.spec.length
        assert (length is not None) == self.ends
        if length is None:
            return
        source.take(0, length - 3)
        with pytest.raises(LogExhaustedError):
            source.take(0, 4)
        with pytest.raises(LogExhaustedError):
            source.take_all(4)
        assert source.t == length - 3
        assert len(source.take(0, 3)) == 3
        with pytest.raises(LogExhaustedError):
            source.take(0, 1)


class SourceContract(ForwardContract):
    """What sources promise that can show any frame again."""

    def test_seek_is_as_if_the_frames_had_been_taken(self, source: SeekableSource) -> None:
        assert isinstance(source, SeekableSource)
        first = source.take(0, 12)
        source.seek(17)
        assert source.t == 17
        with self.another(17) as other:
            same(source.take(0, 6), other.take(0, 6))
        source.seek(0)
        same(source.take(0, 12), first)

    def test_a_frame_before_the_first_is_refused(self, source: SeekableSource) -> None:
        with pytest.raises(ValueError, match="-1"):
            source.seek(-1)
        assert source.t == 0


class CameraContract:
    """The tests; a subclass gives a camera that is not opened yet in `open`.

    Attributes:
        count: images that are waited for.
    """

    count = 3

    def open(self) -> Camera:
        """Make a camera of the kind under test."""
        raise NotImplementedError

    def test_its_images_are_of_one_kind_and_no_older_than_now(self) -> None:
        taken = list(itertools.islice(self.open().images(), self.count))
        assert len(taken) == self.count
        for age, image in taken:
            assert age >= 0
            if image.ndim == 1:
                assert image.dtype == np.float64, "numbers are (I,) float64"
                assert np.isfinite(image).all(), "numbers are finite"
            else:
                assert image.dtype == np.uint8
                assert image.shape[2:] in ((), (3,)), "gray (height, width), or with 3 colours"
            assert image.size
        assert len({(image.ndim, image.shape[2:]) for _, image in taken}) == 1
        assert len({image.shape for _, image in taken if image.ndim == 1}) <= 1

    def test_it_can_be_opened_again(self) -> None:
        camera = self.open()
        for _ in range(2):  # as after a loss
            images = camera.images()
            assert next(iter(images))[1].size
            if hasattr(images, "close"):
                images.close()

    def test_its_description_is_json(self) -> None:
        camera = self.open()
        described = dict(camera.describe())
        assert json.loads(json.dumps(described)) == described
        assert camera.name
        assert isinstance(camera.finite, bool)
        assert camera.rate is None or camera.rate > 0
