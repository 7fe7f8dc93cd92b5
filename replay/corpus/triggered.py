"""Live streams of which only what is novel is kept, with what was before it and after it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from cdmisfa.core.blocks import (
    Block,
    ForwardSource,
    FrameSource,
    SourceSpec,
    check_request,
    take_unbroken,
    unbroken,
)
from cdmisfa.core.errors import LogExhaustedError, UsageError
from cdmisfa.core.names import counted
from replay.corpus.choosing import Features, usual_distance
from replay.corpus.judging import (
    LEAST,
    NOVEL,
    VERDICTS,
    Applies,
    Verdict,
    frames_of_block,
    verdict_on,
)
from replay.export.applied import Applied

MOST_HELD: Final = 2**30
"""Bytes of frames that are held until it is known whether they are kept."""

FAR: Final = 0.5
"""A block is new above this share of what two blocks of its stream differ by in the mean."""


@dataclass(slots=True)
class Trigger:
    """Novel frames of a stream that follow one another, [start, stop).

    Attributes:
        stream: its name.
        start: the first.
        stop: behind the last.
        novelty: the highest of its blocks, 1 and above; None where there was nothing to compare
            the first with.
    """

    stream: str
    start: int
    stop: int
    novelty: float | None


@dataclass(slots=True)
class Kept:
    """A segment that is kept of all streams, the frames [start, stop).

    Attributes:
        start: the first.
        stop: behind the last, so far.
        triggers: why, in their order.
    """

    start: int
    stop: int
    triggers: list[Trigger] = field(default_factory=list)

    def add(self, trigger: Trigger) -> None:
        """Add a trigger; one that goes on with the last of its stream makes that longer."""
        for earlier in reversed(self.triggers):
            if earlier.stream == trigger.stream and earlier.stop == trigger.start:
                both = [x for x in (earlier.novelty, trigger.novelty) if x is not None]
                earlier.stop, earlier.novelty = trigger.stop, max(both, default=None)
                return
        self.triggers.append(trigger)


class TriggeredSource(ForwardSource):
    """What a source shows from some time before something novel until some time after it.

    All else is a gap of all streams. Frames keep their numbers and their times. What is kept are
    the frames [start - before, stop + after) of each novel block [start, stop) of any stream, with
    those of all streams. Frames are held until that is decided: so many as are before, and a block.

    With a run, novel is what `curate` calls so: what none of its modules knows and is no noise.
    Without one it is what differs from every block that was novel before by more than half of what
    two blocks of its stream differ by in the mean. What stands still is never novel.

    Args:
        source: closed with this; it need not be able to go back.
        before: seconds that are kept before what is novel.
        after: seconds that are kept after it.
        known: modules of a run, as `Application`.
        known_as: the run.
        frames: end after so many; by default where the source ends.
        say: told in a line when a segment begins, and when it has ended.

    Attributes:
        segments: that are kept, in their order.
        stop: asked before every frame; true ends the source. What is held is then given.

    Raises:
        UsageError: more frames would be held than fit, or the modules cannot take the streams.
    """

    gaps = True

    def __init__(
        self,
        source: FrameSource,
        *,
        before: float,
        after: float,
        known: Applies | None = None,
        known_as: str | None = None,
        frames: int | None = None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.segments: list[Kept] = []
        self.stop: Callable[[], bool] = lambda: False
        self._source, self._spec, self._t = source, source.spec, source.t
        self._first, self._last = source.t, None if frames is None else source.t + frames
        self._before, self._after = (round(s * self._spec.fps) for s in (before, after))
        self._tau = frames_of_block(self._spec, known)
        self._novelty = _Novelty(self._spec, known)
        self._told = {"when": VERDICTS[NOVEL], "before": before, "after": after, "known": known_as}
        self._held: deque[Sequence[Block]] = deque()
        self._starts: list[int] = []
        self._judged, self._over, self._open = source.t, "", False
        self._say = say
        _refuse_too_much(self._spec, self._before, self._tau)

    @property
    def held(self) -> int:
        """Frames that were read and are not given yet."""
        return len(self._held)

    @property
    def kept(self) -> int:
        """Frames of the clock that are kept so far."""
        return sum(segment.stop - segment.start for segment in self.segments)

    @property
    def alignment(self) -> Mapping[str, Mapping[str, int]]:
        """See `LiveSource`; empty of sources that count nothing."""
        return getattr(self._source, "alignment", {})

    def take(self, stream: int, n: int) -> Block:
        """The next n kept frames of a stream that follow one another; see `FrameSource`."""
        return take_unbroken(self, stream, n)

    def take_all(self, n: int) -> tuple[Block, ...]:
        """What is kept of the next n frames; see `FrameSource`."""
        check_request(self._spec, 0, n)
        if self.stop():
            self._end(f"stopped at frame {self._judged}")
        while self._decided() < self._t + n and not self._over:
            self._read()
        if self._decided() < self._t + n:
            raise LogExhaustedError(self._over)
        given: list[Block] = []
        for t in range(self._t, self._t + n):
            blocks = self._held.popleft()
            if self._is_kept(t):
                given += blocks
        self._t += n
        return tuple(unbroken(given))

    def describe(self) -> Mapping[str, Any]:
        """What identifies the source, and what of it is kept."""
        return {**self._source.describe(), "triggered": {**self._told, "block": self._tau}}

    def triggered(self) -> dict[str, Any]:
        """End, and say what was kept and why, as JSON values."""
        self._end(f"closed at frame {self._judged}")
        watched = self._judged - self._first
        share = self.kept / watched if watched else 0.0
        return {
            **self._told,
            "watched": watched,
            "kept": self.kept,
            "share": round(share, 6),
            "segments": [asdict(segment) for segment in self.segments],
        }

    def close(self) -> None:
        """Let go of the source."""
        self._source.close()

    def _decided(self) -> int:
        """Behind the last frame of which is known whether it is kept."""
        if self._over:
            return self._judged
        stop = self.segments[-1].stop if self.segments else 0
        return max(self._judged - self._before, min(stop, self._judged))

    def _is_kept(self, t: int) -> bool:
        number = bisect_right(self._starts, t) - 1
        return number >= 0 and t < self.segments[number].stop

    def _read(self) -> None:
        """Read to where a block of the clock ends, and judge it."""
        blocks: list[Block] = []
        over = ""
        if hasattr(self._source, "stop"):
            self._source.stop = self.stop
        for _ in range(self._tau - self._source.t % self._tau):
            try:
                self._held.append(self._source.take_all(1))
            except LogExhaustedError as error:
                over = str(error)
                break
            blocks += self._held[-1]
            if self._source.t == self._last or self.stop():
                over = f"ended at frame {self._source.t}"
                break
        self._judged = self._source.t
        for trigger in self._novelty.triggers(unbroken(blocks)):
            self._keep(trigger)
        if over:
            self._end(over)
        elif self.segments and self._judged - self._before > self.segments[-1].stop:
            self._say_ended()

    def _end(self, why: str) -> None:
        """Read nothing more; what is held is decided."""
        if not self._over:
            self._over = why
            if self.segments:
                self.segments[-1].stop = min(self.segments[-1].stop, self._judged)
            self._say_ended()

    def _keep(self, trigger: Trigger) -> None:
        start = max(trigger.start - self._before, self._first)
        stop = trigger.stop + self._after
        if self.segments and start <= self.segments[-1].stop:
            self.segments[-1].stop = max(self.segments[-1].stop, stop)
        else:
            self._say_ended()
            self.segments.append(Kept(start, stop))
            self._starts.append(start)
            self._open = True
            why = "nothing before" if trigger.novelty is None else f"novelty {trigger.novelty:.2f}"
            self._say(
                f"novel at {self._at(trigger.start)}: {trigger.stream} ({why}); kept from "
                f"{self._at(start)} on"
            )
        self.segments[-1].add(trigger)

    def _say_ended(self) -> None:
        if self._open:
            last, self._open = self.segments[-1], False
            seconds = (last.stop - last.start) / self._spec.fps
            self._say(f"kept to {self._at(last.stop)}: {seconds:.1f} s")

    def _at(self, t: int) -> str:
        return f"frame {t} ({t / self._spec.fps:.1f} s)"


class _Novelty:
    """Which blocks of a source are novel.

    Args:
        spec: of the source.
        known: modules of a run.
    """

    def __init__(self, spec: SourceSpec, known: Applies | None) -> None:
        self._spec = spec
        self._modules = known.modules if known else ()
        self._apply = known.judge(spec) if known else None
        self._seen = [_Seen(pictures=spec.images) for _ in spec.streams]

    def triggers(self, blocks: Sequence[Block]) -> Iterator[Trigger]:
        """The novel ones of the blocks that follow, in their order."""
        found: list[tuple[Block, Applied | None]] = (
            [(block, None) for block in sorted(blocks, key=lambda one: (one.t, one.stream))]
            if self._apply is None
            else [(applied.block, applied) for applied in self._apply(blocks)]
        )
        for block, applied in found:
            if len(block) < LEAST:
                continue
            judged = verdict_on(block, applied, self._modules)
            if judged.kind != NOVEL:
                continue
            novel = not judged.shown.still
            novelty = None if math.isnan(judged.novelty) else judged.novelty
            if applied is None:
                novel, novelty = self._seen[block.stream].judge(judged)
            if novel:
                stream = self._spec.streams[block.stream]
                yield Trigger(stream, block.t, block.t + len(block), novelty)


class _Seen:
    """The blocks of one stream so far: how much they differ, and those that were new."""

    def __init__(self, *, pictures: bool) -> None:
        self._pictures = pictures
        self._new: list[Features] = []
        self._count = 0
        self._mean: Any = 0.0
        self._squares: Any = 0.0

    def judge(self, found: Verdict) -> tuple[bool, float | None]:
        """Whether a block is new, and its distance to the nearest that was, 1 at the bound."""
        features = found.shown.features.astype(np.float64)
        self._count += 1
        away = features - self._mean
        self._mean = self._mean + away / self._count
        self._squares = self._squares + away * (features - self._mean)
        if found.shown.still:
            return False, None
        novelty = None
        if self._new:
            variance = float(self._squares.sum()) / self._count
            bound = FAR * usual_distance(variance, len(features), pictures=self._pictures)
            novelty = float(np.linalg.norm(np.array(self._new) - features, axis=1).min()) / bound
            if novelty < 1:
                return False, novelty
        self._new.append(found.shown.features)
        return True, novelty


def _refuse_too_much(spec: SourceSpec, before: int, tau: int) -> None:
    """Refuse to hold more frames than fit.

    Raises:
        UsageError: it says how long before may be.
    """
    frame = math.prod(spec.frame_shape) * np.dtype(spec.dtype).itemsize
    each = len(spec.streams) * (frame + 8 * len(spec.truth))
    if (before + tau) * each > MOST_HELD:
        most = max(MOST_HELD // each - tau, 0) / spec.fps
        shape = "x".join(map(str, reversed(spec.frame_shape)))
        raise UsageError(
            f"--before {before / spec.fps:g}s holds {before:,} frames of {shape} of "
            f"{counted(len(spec.streams), 'stream')} in memory, {(before + tau) * each / 1e9:.3g} "
            f"GB: ask for {math.floor(most * 10) / 10:g}s at most, or smaller frames"
        )
