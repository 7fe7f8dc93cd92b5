"""Names of streams and columns, and texts for counts and durations."""

from __future__ import annotations

import itertools
import re
import unicodedata
from collections.abc import Iterable
from datetime import timedelta

# Prefixes that mark a view in a topic of a recording or in a column of a LeRobot dataset.
_VIEW_PREFIXES = re.compile(r"(/view/|observation\.images\.)+(?=.)")

# Longest name of a stream: with the endings of files it stays below the 255 bytes of file systems.
_MAX_NAME = 64

# Prefixes of the columns of truth that hold an action, mark the start of an episode with 1, or
# hold a joint angle of the robot.
ACTION, BEGINS, JOINT = "action_", "begins_", "head_"

# Words in the names of topics with commands, not states.
COMMANDS = ("action", "command", "cmd", "target", "goal", "desired", "leader")


def counted(number: int, noun: str, form: str = "") -> str:
    """Return a count with its noun, such as "1 block" or "2 blocks".

    Args:
        number: the count.
        noun: the noun in the singular.
        form: format specification of the number, such as ",".
    """
    return f"{number:{form}} {noun}{'' if number == 1 else 's'}"


def kind_of_frames(shape: tuple[int, ...]) -> str:
    """Return what frames of a shape are, such as "2 numbers" or "images of 80x60"."""
    return counted(shape[0], "number") if len(shape) < 2 else f"images of {shape[1]}x{shape[0]}"


def duration_text(seconds: float | None) -> str:
    """Return a duration such as "1:02:03", or "-" for None."""
    return "-" if seconds is None else str(timedelta(seconds=round(seconds)))


def is_command(topic: str) -> bool:
    """Return whether a topic of joints holds commands instead of states, by its name."""
    return any(word in topic.lower() for word in COMMANDS)


def stream_name(label: str) -> str:
    """Return the name of a stream, valid as a file name, for its label in a log or of a camera.

    The topic /cam/left becomes cam_left. A view keeps its name: the topic /view/left and the
    dataset column observation.images.left both become left. Accents are removed from letters;
    letters of other scripts stay.
    """
    letters = unicodedata.normalize("NFKD", _VIEW_PREFIXES.sub("", label))
    bare = "".join(c for c in letters if not unicodedata.combining(c))
    return re.sub(r"[^\w.-]+", "_", bare).strip("._-")[:_MAX_NAME].rstrip("._-") or "stream"


def stream_names(labels: Iterable[str]) -> tuple[str, ...]:
    """Return distinct `stream_name`s: a repeated name gets a number, as in cam-2.

    A name also counts as repeated if an earlier name continues it with a hyphen: cam after cam-left
    becomes cam-2.
    """
    names: list[str] = []
    for name in map(stream_name, labels):
        similar = sum(other == name or other.startswith(f"{name}-") for other in names)
        numbered = (f"{name}-{number}" for number in itertools.count(similar + 1))
        names.append(next(n for n in numbered if n not in names) if similar else name)
    return tuple(names)
