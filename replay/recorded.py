"""A recording as a source of frames: the learner cannot tell it from the live scene."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.blocks import Block, SourceSpec, check_request, freeze
from cdmisfa.errors import CdmisfaError, LogDamagedError, LogExhaustedError, UsageError
from replay.viewfile import ViewFacts, ViewFile

CACHE_BYTES: Final = 128 * 1024 * 1024
"""Decoded chunks that a source keeps, over all its views."""
_SAME: Final = ("frame_shape", "dtype", "truth", "fps", "start_ns")
_SAME_VALUES: Final = ("scene", "seed", "config_sha256")


class RecordedSource:
    """The views of a recording on their common clock.

    Args:
        paths: a recording's folder, or the files of its views, finished or `.partial`.
        loop: begin again at the end instead of stopping there.
        salvage: leave out, in every view, what is damaged in one of them.

    Attributes:
        warnings: what the user should know: files that were cut, frames left out.
    """

    def __init__(
        self, paths: str | Path | Iterable[str | Path], *, loop: bool = False, salvage: bool = False
    ) -> None:
        """Open every view and check that they belong together.

        Raises:
            UsageError: no such recording.
            LogDamagedError: a file is damaged, or the files contradict each other.
        """
        self.warnings: tuple[str, ...] = ()
        self._loop = loop
        self._files = view_files(paths)
        self._hashes: list[dict[str, Any]] | None = None
        self._views: list[list[ViewFile]] = []
        opened: list[ViewFile] = []
        try:
            for path in self._files:
                share = CACHE_BYTES // len(self._files)
                opened.append(ViewFile(path, salvage=salvage, cache_bytes=share))
            self._views = _arrange(opened)
            self._set_clock()
        except BaseException:
            for view in opened:
                view.close()
            raise

    @property
    def spec(self) -> SourceSpec:
        """What the recording delivers; without a length where it loops."""
        return self._spec

    @property
    def t(self) -> int:
        """Number of the next frame."""
        return self._t

    @property
    def frames(self) -> int:
        """Frames that every view has."""
        return self._count

    def take(self, stream: int, n: int) -> Block:
        """The n frames that a view shows at t .. t+n-1; moves t by n.

        Raises:
            LogExhaustedError: fewer than n frames are left; t stays.
            LogDamagedError: a chunk is damaged; t stays.
            ValueError: no such stream, or n < 1.
        """
        check_request(self._spec, stream, n)
        played = self._t - self._first
        if not self._loop and played + n > self._count:
            raise LogExhaustedError(
                f"{self._name()}: {self._count - played} frames are left at frame {self._t}, "
                f"{n} are needed; record more frames, or begin again at its end with --loop"
            )
        frames = np.empty((n, *self._spec.frame_shape), self._spec.dtype)
        truth = np.empty((n, len(self._spec.truth)))
        at = 0
        while at < n:
            view, row, count = self._place(stream, (played + at) % self._count, n - at)
            view.frames(row, frames[at : at + count])
            view.truth(row, truth[at : at + count])
            at += count
        block = Block(stream, self._t, freeze(frames), freeze(truth))
        self._t += n
        return block

    def seek(self, t: int) -> None:
        """Move the clock to frame t.

        Raises:
            LogExhaustedError: the recording ends before it.
            ValueError: t lies before the recording's first frame.
        """
        if t < self._first:
            raise ValueError(f"frame {t} lies before the recording's first, {self._first}")
        if not self._loop and t > self._first + self._count:
            raise LogExhaustedError(
                f"{self._name()}: it ends at frame {self._first + self._count}, before frame {t}; "
                "begin again at its end with --loop"
            )
        self._t = t

    def describe(self) -> Mapping[str, Any]:
        """The recording's views with the SHA-256 of their files, and what was recorded."""
        if self._hashes is None:
            self._hashes = [
                {
                    "name": view.facts.view,
                    "file": view.path.name,
                    "frames": view.count,
                    "sha256": sha256(view.path),
                }
                for parts in self._views
                for view in parts
            ]
        values = self._views[0][0].facts.values
        return {
            "kind": "recording",
            **{k: values[k] for k in ("scene", "seed", "config_sha256") if k in values},
            "frames": self._count,
            "first_frame": self._first,
            "loop": self._loop,
            "views": self._hashes,
        }

    def close(self) -> None:
        """Let go of the files; harmless when called twice."""
        for parts in self._views:
            for view in parts:
                view.close()

    def _name(self) -> str:
        parents = {path.parent for path in self._files}
        return str(self._files[0] if len(self._files) == 1 else sorted(parents)[0])

    def _set_clock(self) -> None:
        """Find the frames that every view has, whole."""
        facts = [parts[0].facts for parts in self._views]
        stops = [parts[-1].facts.first_frame + parts[-1].count for parts in self._views]
        self._first = max(f.first_frame for f in facts)
        stop = min(stops)
        if stop <= self._first:
            raise LogDamagedError(f"{self._name()}: no frame is there in every view")
        keep = np.ones(stop - self._first, bool)
        warnings = [
            f"{view.path}: {view.reader.missing}"
            for parts in self._views
            for view in parts
            if view.reader.missing
        ]
        for parts in self._views:
            for view in parts:
                shift = view.facts.first_frame - self._first
                for low, high in view.lost:
                    keep[max(low + shift, 0) : max(high + shift, 0)] = False
                warnings += [f"{view.path}: {p.where}: {p.what}" for p in view.reader.problems]
        if len(set(stops)) > 1:
            warnings.append(
                f"{self._name()}: its views end at different frames, the {stop - self._first} "
                "frames that all have are used"
            )
        edges = np.flatnonzero(np.diff(np.concatenate([[0], keep.astype(np.int8), [0]])))
        self._ranges = edges.reshape(-1, 2) + self._first
        self._range_starts = np.concatenate(
            [[0], np.cumsum(self._ranges[:, 1] - self._ranges[:, 0])]
        )
        self._count = int(self._range_starts[-1])
        if not self._count:
            raise LogDamagedError(f"{self._name()}: no frame is whole in every view")
        if self._count < len(keep):
            warnings.append(
                f"{self._name()}: {len(keep) - self._count} frames are damaged in a view and left "
                "out in all"
            )
        self.warnings = tuple(warnings)
        self._t = self._first
        self._spec = SourceSpec(
            tuple(f.view for f in facts),
            facts[0].frame_shape,
            facts[0].dtype,
            facts[0].truth,
            facts[0].fps,
            facts[0].start_ns,
            None if self._loop else self._count,
        )

    def _place(self, stream: int, played: int, wanted: int) -> tuple[ViewFile, int, int]:
        """Where the frame `played` from the start lies: file, row there, frames that follow."""
        number = int(np.searchsorted(self._range_starts, played, side="right")) - 1
        low, high = (int(edge) for edge in self._ranges[number])
        frame = low + played - int(self._range_starts[number])
        parts = self._views[stream]
        view = next(v for v in reversed(parts) if v.facts.first_frame <= frame)
        row = frame - view.facts.first_frame
        return view, row, min(wanted, high - frame, view.count - row)


def view_files(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """The files of a recording: those in a folder, or those named.

    A `.partial` counts where the finished file is not there.

    Raises:
        UsageError: there is none.
    """
    if isinstance(paths, str | Path):
        paths = [paths]
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            found = sorted(path.glob("*.mcap"))
            cut = [p for p in sorted(path.glob("*.mcap.partial")) if p.with_suffix("") not in found]
            if not found and not cut:
                raise UsageError(f"{path}: no .mcap file in this folder; record one first")
            files += found + cut
        elif path.exists():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    if not files:
        raise UsageError("no recording was named")
    return files


def sha256(path: Path) -> str:
    """SHA-256 of a file, read piece by piece.

    Raises:
        CdmisfaError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CdmisfaError(f"{path}: {error.strerror}") from None


def _arrange(opened: list[ViewFile]) -> list[list[ViewFile]]:
    """Views by stream index, each as its parts by first frame."""
    by_view: dict[tuple[int, str], list[ViewFile]] = {}
    for view in opened:
        by_view.setdefault((view.facts.stream_index, view.facts.view), []).append(view)
    indexes = [index for index, _ in by_view]
    names = [name for _, name in by_view]
    if len(set(indexes)) < len(indexes) or len(set(names)) < len(names):
        raise LogDamagedError(
            f"{opened[0].path}: its files are not of one recording: two claim the same stream"
        )
    first = opened[0]
    for view in opened[1:]:
        key = _difference(first.facts, view.facts)
        if key:
            raise LogDamagedError(
                f"{view.path}: not of the same recording as {first.path.name}: {key} differs"
            )
    arranged = []
    for stream in sorted(by_view):
        parts = sorted(by_view[stream], key=lambda v: v.facts.first_frame)
        for one, two in itertools.pairwise(parts):
            if one.facts.first_frame + one.count != two.facts.first_frame:
                raise LogDamagedError(
                    f"{two.path}: begins at frame {two.facts.first_frame}, {one.path.name} ends "
                    f"at {one.facts.first_frame + one.count}: a part is missing or doubled"
                )
        arranged.append(parts)
    return arranged


def _difference(one: ViewFacts, two: ViewFacts) -> str:
    for key in _SAME:
        if getattr(one, key) != getattr(two, key):
            return key
    for key in _SAME_VALUES:
        if one.values.get(key) != two.values.get(key):
            return key
    return ""
