"""A recording's folder: held by one process at a time, and what it was asked to hold."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from cdmisfa.core.errors import UsageError

ASKED = "recording.json"
"""What each unfinished view was asked to be; gone when all are finished.

Beside the logs, because these hold the same bytes whatever length was asked for first.
"""


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep every other process that asks out of a folder; a kill lets go of it too.

    Raises:
        UsageError: another process holds it, or there is no such folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise UsageError(f"{folder} is no folder that can be opened: {error.strerror}") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                f"{folder} is in use by another process: wait for it, or choose another folder"
            ) from error
        except OSError:
            pass  # A file system without locks: nothing can be held there.
        yield
    finally:
        os.close(handle)


@dataclass(frozen=True, slots=True)
class Asked:
    """What the unfinished views of a folder were asked to be.

    Attributes:
        frames: of each view, how many.
        split: of each view that is split, where its parts end.
        scene: that was recorded; empty where nobody knows.
        seed: of the scene; None where nobody knows.
    """

    frames: Mapping[str, int] = field(default_factory=dict)
    split: Mapping[str, str] = field(default_factory=dict)
    scene: str = ""
    seed: int | None = None

    def length(self, views: Sequence[str]) -> int | None:
        """The most frames that one of some views was asked to have; None: nobody knows."""
        return max((self.frames[view] for view in views if view in self.frames), default=None)


def asked(folder: Path) -> Asked:
    """Read what the unfinished views of a folder were asked to be, as far as it says so."""
    try:
        noted = json.loads((folder / ASKED).read_text("utf-8"))
        frames = {str(view): n for view, n in noted["frames"].items() if _is_count(n) and n > 0}
        split = {v: limit for v, limit in noted.get("split", {}).items() if isinstance(limit, str)}
        scene, seed = noted.get("scene", ""), noted.get("seed")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return Asked()
    return Asked(
        frames,
        split,
        scene if isinstance(scene, str) else "",
        seed if _is_count(seed) and 0 <= seed < 2**63 else None,
    )


def ask(folder: Path, wanted: Asked) -> None:
    """Note what some views shall be, so that they can be gone on with.

    Raises:
        OSError: the disk does not take it.
    """
    known = _without(asked(folder), list(wanted.frames))
    frames, split = {**known.frames, **wanted.frames}, {**known.split, **wanted.split}
    _write(folder, replace(wanted, frames=frames, split=split))


def answered(folder: Path, views: Sequence[str]) -> None:
    """Forget what was asked of some views, which are finished.

    Raises:
        OSError: the disk does not take it.
    """
    _write(folder, _without(asked(folder), views))


def _without(known: Asked, views: Sequence[str]) -> Asked:
    return replace(
        known,
        frames={view: n for view, n in known.frames.items() if view not in views},
        split={view: limit for view, limit in known.split.items() if view not in views},
    )


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _write(folder: Path, noted: Asked) -> None:
    path = folder / ASKED
    if not noted.frames:
        path.unlink(missing_ok=True)
        return
    partial = path.with_name(f".{ASKED}")
    partial.write_text(json.dumps(asdict(noted)) + "\n", "utf-8")
    os.replace(partial, path)
