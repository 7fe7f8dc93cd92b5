"""The folder of a rosbag2: what its metadata.yaml says, and its files unpacked."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Final

import zstandard

from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.untrusted.regular import check_regular, opened_regular, read_regular
from recorder.mcap.records import MAX_CHUNK
from replay.camera_logs.stream import explained

METADATA: Final = "metadata.yaml"
MAX_METADATA: Final = 1024 * 1024
"""Largest metadata.yaml that is read, in bytes."""
MOST_TIMES: Final = 100
"""How many times the size of a packed file what is in it may have, where it is more than a chunk's.

Images of anything but one colour are packed to more than that.
"""
_WINDOW: Final = MAX_CHUNK // 2
_KEY: Final = "rosbag2_bagfile_information"
_PART: Final = 1 << 20


@contextlib.contextmanager
def plain_bag(path: Path) -> Iterator[tuple[Path, bool]]:
    """A bag whose files are as they were before they were packed, for as long as the body runs.

    Args:
        path: a file, or the folder of a rosbag2.

    Yields:
        The same bag or a copy, and whether its messages are packed, each for itself.

    Raises:
        UsageError: a file of it is no regular one.
        LogDamagedError: it is no rosbag2, or unpacks to far more than it is.
    """
    if not path.is_dir():
        yield path, False
        return
    from ruamel.yaml import YAML

    with explained(path / METADATA, "YAML"):
        whole = YAML(typ="safe").load(read_regular(path / METADATA, MAX_METADATA).decode("utf-8"))
        said = whole[_KEY]
        names = [PurePath(str(name)).name for name in said["relative_file_paths"]]
        packed = str(said.get("compression_mode") or "").lower()
        kept_as = str(said["storage_identifier"])
    if kept_as != "sqlite3":
        raise LogDamagedError(
            f"{path}: files of {kept_as[:40]} are read if they are MCAP and called .mcap: "
            "unpack them with zstd -d"
        )
    for name in names:
        check_regular(path / name)
    if packed != "file":
        yield path, packed == "message"
        return
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary)
        for name in names:
            _unpack(path / name, copy / PurePath(name).stem)
        said["relative_file_paths"] = [PurePath(name).stem for name in names]
        said["compression_mode"] = said["compression_format"] = ""
        with (copy / METADATA).open("w", encoding="utf-8") as file:
            YAML(typ="safe").dump(whole, file)
        yield copy, False


def unpacked_message(data: bytes) -> bytes:
    """A packed message as it was.

    Raises:
        ValueError: it unpacks to more than a chunk of a log may.
    """
    unpacking = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
    with unpacking.stream_reader(io.BytesIO(data), read_across_frames=True) as reader:
        found = reader.read(MAX_CHUNK + 1)
    if len(found) > MAX_CHUNK:
        raise ValueError(f"a message unpacks to more than {MAX_CHUNK} bytes, the limit")
    return bytes(found)


def _unpack(packed: Path, target: Path) -> None:
    """Unpack a file into another, unless it becomes far too large or leaves no room on the disk.

    Raises:
        LogDamagedError: so it is, or it is not packed by zstd.
    """
    unpacking = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
    with explained(packed, "zstd"), opened_regular(packed) as source, target.open("xb") as out:
        most = max(os.fstat(source.fileno()).st_size * MOST_TIMES, MAX_CHUNK)
        most = min(most, shutil.disk_usage(target.parent).free // 2)
        with unpacking.stream_reader(source, read_across_frames=True) as reader:
            while part := reader.read(_PART):
                out.write(part)
                if out.tell() > most:
                    raise LogDamagedError(
                        f"{packed} unpacks to more than {most} bytes, the limit: unpack it with "
                        f"zstd -d, and take compression_mode out of {METADATA}"
                    )
