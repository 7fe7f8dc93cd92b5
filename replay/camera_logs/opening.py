"""Opening camera logs of any kind: which logs paths mean, of what kind they are, what they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cdmisfa.core.errors import UsageError
from recorder.images.decoding import IMAGES, Reading
from replay.camera_logs.formats.bag import BAGS, BagImages
from replay.camera_logs.formats.lerobot import LeRobotImages, is_dataset
from replay.camera_logs.formats.mcap_log import McapImages
from replay.camera_logs.formats.picture_folder import PICTURES, FolderImages, by_number
from replay.camera_logs.formats.table import TableNumbers, is_table
from replay.camera_logs.formats.video import VIDEOS, VideoImages
from replay.camera_logs.joined import JoinedImages, Stamped
from replay.camera_logs.stream import ImageStream, NothingLoggedError
from replay.camera_logs.video_messages import in_order
from replay.storage.identity import FilesIdentity, Identity, log_identity
from replay.storage.location import Location, Url, location
from replay.storage.opening import log_files


def open_images(
    path: Location, topic: str | None, *, salvage: bool = False, reading: Reading = IMAGES
) -> ImageStream:
    """Open the images on a topic of a log, or in a folder, or numbers, at the times wanted.

    Args:
        path: an MCAP log or its URL, a ROS bag, a video, a table or a folder of pictures.
        topic: may be left out where there is one topic of images.
        salvage: leave out what is damaged.
        reading: what is taken of messages and tables, and by which times.

    Raises:
        UsageError: no such topic, or not what is wanted on it.
        LogDamagedError: the log is damaged.
    """
    images = _open(path, topic, salvage=salvage, reading=reading)
    try:
        images = in_order(images)
    except BaseException:
        images.close()
        raise
    if reading.stamp == "log":
        return images
    try:
        return Stamped(images)
    except BaseException:
        images.close()
        raise


def _open(path: Location, topic: str | None, *, salvage: bool, reading: Reading) -> ImageStream:
    """Open a log with the reader of its format, which raises as `open_images` does."""
    if isinstance(path, Path):
        if is_table(path):
            return TableNumbers(path, topic, reading)
        if is_bag(path):
            return BagImages(path, topic, reading=reading)
        if is_split(path):
            return _open_parts(path, topic, salvage=salvage, reading=reading)
        if reading.fields and (path.is_dir() or is_video(path)):
            raise UsageError(f"{path} holds images: --field is for messages and tables")
        if is_dataset(path):
            return LeRobotImages(path, topic, color=reading.color)
        if path.is_dir():
            return FolderImages(path, topic, color=reading.color)
        if is_video(path):
            return VideoImages(path, topic, color=reading.color)
    return McapImages(path, topic, salvage=salvage, reading=reading)


def image_logs(paths: Sequence[str | Location]) -> list[Location]:
    """The logs that paths mean, one at least: a folder of MCAP files is each, a rosbag2 one log."""
    found: list[Location] = []
    for path in map(location, paths):
        if only_foreign(path) or (isinstance(path, Path) and is_split(path)):
            found.append(path)
        else:
            found += log_files(path)
    return found


def only_foreign(path: Location) -> bool:
    """Whether a path can be no recording of ours, by its kind."""
    if isinstance(path, Url):
        return False
    if is_table(path):
        return True
    return is_video(path) or is_dataset(path) or is_bag(path) or is_picture_folder(path)


def identity_of(path: Location, streams: Sequence[ImageStream]) -> Identity:
    """The identity of a log: its bytes; of a folder, names and contents count.

    The streams hold the log open, where it is an MCAP file.

    Raises:
        ValueError: it is at a URL, and none of the streams holds it open.
    """
    readers = [s.reader for s in streams if isinstance(s, McapImages) and s.path == path]
    if readers:
        return log_identity(*readers)
    if isinstance(path, Url):
        raise ValueError(f"{path} is not open")
    if not path.is_dir():
        return FilesIdentity(path)
    found = path.rglob("*") if is_dataset(path) else path.iterdir()
    return FilesIdentity(path, (file for file in found if file.is_file()))


def _open_parts(path: Path, topic: str | None, *, salvage: bool, reading: Reading) -> ImageStream:
    """Open the images on a topic of a log in parts.

    A part may lack a topic that is named, and one that has nothing in it is left out.
    """
    parts: list[ImageStream] = []
    refusal: UsageError | None = None
    empty: list[NothingLoggedError] = []
    try:
        for file in sorted(path.glob("*.mcap"), key=by_number):
            try:
                parts.append(McapImages(file, topic, salvage=salvage, reading=reading))
            except NothingLoggedError as error:
                empty.append(error)
            except UsageError as error:
                refusal = refusal or error
        if refusal is not None and (topic is None or not parts):
            raise refusal
        if not parts:
            raise empty[0]
        topics = {part.topic for part in parts}
        if len(topics) > 1:
            raise UsageError(
                f"{path}: name one --topic or more; it has {', '.join(sorted(topics))}"
            )
    except BaseException:
        for part in parts:
            part.close()
        raise
    return JoinedImages(path, parts, [f"{error}: left out" for error in empty])


def is_video(path: Path) -> bool:
    """Whether a file is a video, by its name."""
    return path.suffix.lower() in VIDEOS and path.is_file()


def is_bag(path: Path) -> bool:
    """A ROS bag that is not in MCAP files."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() and not any(path.glob("*.mcap"))
    return path.suffix in BAGS


def is_picture_folder(path: Path) -> bool:
    """Whether a folder holds pictures, and no log."""
    return (
        path.is_dir()
        and not any(path.glob("*.mcap*"))
        and any(p.suffix.lower() in PICTURES for p in path.iterdir())
    )


def is_split(path: Path) -> bool:
    """Whether a folder is a rosbag2 of MCAP files, which are parts of one log."""
    return (path / "metadata.yaml").is_file() and any(path.glob("*.mcap"))
