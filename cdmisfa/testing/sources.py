"""What every `FrameSource` promises, as tests: say what to open.

`ForwardContract` is for all sources, `SourceContract` for those that can go back, too:

    class TestOscillatory(SourceContract):
        def open(self) -> SeekableSource:
            return OscillatorySource()
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

from cdmisfa.core.blocks import Block, FrameSource, SeekableSource
from cdmisfa.core.errors import LogExhaustedError


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
        """A fresh source, closed afterwards."""
        source = self.open()
        yield source
        source.close()

    def test_it_is_a_frame_source_at_frame_zero(self, source: FrameSource) -> None:
        assert isinstance(source, FrameSource)
        assert source.t == 0
        assert len(source.spec.streams) >= 1
        assert len(set(source.spec.streams)) == len(source.spec.streams)

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

    def test_the_log_time_of_a_frame_is_the_start_plus_its_share(self, source: FrameSource) -> None:
        spec = source.spec
        assert spec.time_ns(0) == spec.start_ns
        assert spec.time_ns(3) == spec.start_ns + round(3e9 / spec.fps)

    def test_frames_do_not_depend_on_how_they_are_cut(self, source: FrameSource) -> None:
        parts = (self.long * 3 // 8, self.long - self.long * 3 // 8)
        cut = [source.take(0, n) for n in parts]
        other = self.open()
        whole = other.take(0, self.long)
        other.close()
        np.testing.assert_array_equal(np.concatenate([b.frames for b in cut]), whole.frames)
        np.testing.assert_array_equal(np.concatenate([b.truth for b in cut]), whole.truth)

    def test_which_stream_is_watched_changes_nothing(self, source: FrameSource) -> None:
        last = len(source.spec.streams) - 1
        head = self.long // 2
        source.take(last, head)
        other = self.open()
        other.take(0, head)
        same(source.take(0, self.long - head), other.take(0, self.long - head))
        other.close()

    def test_the_truth_is_the_same_whichever_stream_is_watched(self, source: FrameSource) -> None:
        other = self.open()
        mine = source.take(len(source.spec.streams) - 1, 10).truth
        np.testing.assert_array_equal(mine, other.take(0, 10).truth)
        other.close()

    def test_two_sources_of_the_same_kind_show_the_same(self, source: FrameSource) -> None:
        other = self.open()
        for stream in range(len(source.spec.streams)):
            same(source.take(stream, 7), other.take(stream, 7))
        other.close()

    def test_blocks_are_read_only(self, source: FrameSource) -> None:
        block = source.take(0, 4)
        with pytest.raises(ValueError, match="read-only"):
            block.frames[0] = 0
        with pytest.raises(ValueError, match="read-only"):
            block.truth[:] = 0

    def test_a_block_is_never_written_again(self, source: FrameSource) -> None:
        block = source.take(0, 10)
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
                other = self.open()
                other.take(0, start)
                same(block, other.take(block.stream, n))
                other.close()
                with pytest.raises(ValueError, match="read-only"):
                    block.frames[0] = 0

    @pytest.mark.parametrize("n", [0, -3])
    def test_an_empty_block_is_refused(self, source: FrameSource, n: int) -> None:
        with pytest.raises(ValueError, match="at least one frame"):
            source.take(0, n)
        with pytest.raises(ValueError, match="at least one frame"):
            source.take_all(n)
        assert source.t == 0

    def test_a_stream_that_does_not_exist_is_refused(self, source: FrameSource) -> None:
        for stream in (-1, len(source.spec.streams)):
            with pytest.raises(ValueError, match=f"stream {stream} does not exist"):
                source.take(stream, 3)
        assert source.t == 0

    def test_the_end_is_an_error_and_the_clock_stays(self, source: FrameSource) -> None:
        length = source.spec.length
        if not self.ends:
            assert length is None
            return
        assert length is not None
        source.take(0, length - 3)
        with pytest.raises(LogExhaustedError):
            source.take(0, 4)
        with pytest.raises(LogExhaustedError):
            source.take_all(4)
        assert source.t == length - 3
        assert len(source.take(0, 3)) == 3
        with pytest.raises(LogExhaustedError):
            source.take(0, 1)

    def test_its_description_is_json(self, source: FrameSource) -> None:
        described = dict(source.describe())
        assert described["kind"]
        assert json.loads(json.dumps(described)) == described

    def test_closing_twice_is_harmless(self, source: FrameSource) -> None:
        source.close()
        source.close()


class SourceContract(ForwardContract):
    """What sources promise that can show any frame again."""

    def test_it_is_a_seekable_source(self, source: FrameSource) -> None:
        assert isinstance(source, SeekableSource)

    def test_seek_forwards_is_as_if_the_frames_had_been_taken(self, source: SeekableSource) -> None:
        source.take(0, 2)
        source.seek(17)
        assert source.t == 17
        other = self.open()
        other.take(0, 17)
        same(source.take(0, 6), other.take(0, 6))
        other.close()

    def test_seek_backwards_shows_the_same_again(self, source: SeekableSource) -> None:
        first = source.take(0, 12)
        source.seek(0)
        same(source.take(0, 12), first)

    def test_a_frame_before_the_first_is_refused(self, source: SeekableSource) -> None:
        with pytest.raises(ValueError, match="-1"):
            source.seek(-1)
        assert source.t == 0
