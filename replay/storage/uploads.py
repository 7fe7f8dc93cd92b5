"""The file or folder of a result as objects of an S3 bucket, each checked, and back."""

from __future__ import annotations

import base64
import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.untrusted import check_regular
from recorder.log.files import atomic_write
from replay.storage.location import Url
from replay.storage.opening import copied, open_store
from replay.storage.servers import UnreachableError, ask_s3

PART: Final = 16 * 1024 * 1024
"""Bytes of the parts in which a larger file is sent, each with its MD5, which the server checks."""

NOTES: Final = "-metadata.json"
"""What the name of notes that some exports have beside them has more."""

MOST_PARTS: Final = 10_000
"""Parts that an object may have."""

Progress = Callable[[float, float | None], None]
"""Told how many bytes are done, and how many there are."""


@dataclass(frozen=True, slots=True)
class Stored:
    """An object that is there: its size, and its entity tag, of most servers an MD5."""

    size: int
    tag: str


def objects_below(url: Url) -> dict[str, Stored]:
    """What is stored at an address, below it and beside it, by how its own address goes on.

    "" is the object itself, "/run.mcap" one below it, "-metadata.json" notes beside it.

    Raises:
        UsageError: it names no place in a bucket, or there is no such bucket.
        UnreachableError: the server does not list it.
        CdmisfaError: what reads URLs is not installed.
    """
    bucket, _, key = url.address.removeprefix("s3://").strip("/").partition("/")
    if not key:
        raise UsageError(f"{url} names no place in a bucket: write s3://BUCKET/NAME")
    found: dict[str, Stored] = {}
    more: dict[str, str] = {}
    while True:
        answer = _asked(url, "list_objects_v2", Bucket=bucket, Prefix=key, **more)
        for entry in answer.get("Contents", ()):
            rest = str(_stated(url, entry, "Key"))[len(key) :]
            if rest in ("", NOTES) or rest.startswith("/"):
                size, tag = _stated(url, entry, "Size"), str(_stated(url, entry, "ETag"))
                found[rest] = Stored(int(size), tag.strip('"'))
        if not answer.get("IsTruncated"):
            return found
        more = {"ContinuationToken": _stated(url, answer, "NextContinuationToken")}


def upload(
    local: Path, url: Url, progress: Progress = lambda done, total: None
) -> tuple[int, int, list[str]]:
    """Write a file, or every file of a folder, below an address, each checked once it is there.

    What is there already with the same size and checksum is not sent again.

    Args:
        local: the file or folder.
        url: what it becomes; below it, the files of a folder.
        progress: told after each file.

    Returns:
        How many files there are, how many bytes, and what else is below the address.

    Raises:
        UsageError: there is no such file or folder, or bucket.
        UnreachableError: the server does not take it.
        CdmisfaError: the server has something else than was sent.
    """
    files = _files(local)
    for file in files.values():
        check_regular(file)
    there = objects_below(url)
    sizes = {rest: file.stat().st_size for rest, file in files.items()}
    done, total = 0, sum(sizes.values())
    for rest, file in files.items():
        if rest not in there or not _is_of(there[rest], file):
            _put(file, _below(url, rest))
        done += sizes[rest]
        progress(done, total)
    return len(files), total, sorted(there.keys() - files.keys())


def fetch(url: Url, local: Path, there: Mapping[str, Stored], progress: Progress) -> None:
    """Copy what is below an address into a folder, whole or not at all.

    Args:
        url: of the result.
        local: the folder, which is not there.
        there: what is below the address.
        progress: told after each file.

    Raises:
        UnreachableError: the server does not give it.
        LogDamagedError: it gives something else.
        CdmisfaError: there is no room for it.
    """
    done, total = 0, sum(stored.size for stored in there.values())
    with atomic_write(local) as folder:
        for rest, stored in sorted(there.items()):
            parts = rest.split("/")
            if parts[0] or {"", ".", ".."} & {*parts[1:]}:
                raise UsageError(f"{url}{rest} is no file of a result that is gone on with")
            file = folder.joinpath(*parts[1:])
            file.parent.mkdir(parents=True, exist_ok=True)
            copied(_below(url, rest), file)
            md5 = len(stored.tag) == 32  # of one part, which may be encrypted with another tag
            if file.stat().st_size != stored.size or (md5 and not _is_of(stored, file)):
                raise CdmisfaError(f"{_below(url, rest)}: other bytes came than are stored")
            done += stored.size
            progress(done, total)


def _put(file: Path, url: Url) -> None:
    """Write a file as an object, and see that the server has what was sent."""
    bucket, _, key = url.address.removeprefix("s3://").partition("/")
    place = {"Bucket": bucket, "Key": key}
    if file.stat().st_size <= PART:
        _send(url, "put_object", file.read_bytes(), **place)
    else:
        begun = _asked(url, "create_multipart_upload", **place)
        of = {**place, "UploadId": _stated(url, begun, "UploadId")}
        try:
            sent = []
            for number, data in enumerate(_parts(file), start=1):
                answer = _send(url, "upload_part", data, PartNumber=number, **of)
                sent.append({"PartNumber": number, "ETag": _stated(url, answer, "ETag")})
            _asked(url, "complete_multipart_upload", MultipartUpload={"Parts": sent}, **of)
        except BaseException:
            with contextlib.suppress(CdmisfaError):  # parts that are never completed cost money
                _asked(url, "abort_multipart_upload", **of)
            raise
    answer = _asked(url, "head_object", **place)
    stored = Stored(
        int(_stated(url, answer, "ContentLength")), str(answer.get("ETag", "")).strip('"')
    )
    if not (_is_of(stored, file) or _same_bytes(url, file)):
        raise CdmisfaError(f"{url}: the server has other bytes than were sent")


def _asked(url: Url, call: str, **words: Any) -> Any:
    """The answer to a call of the S3 interface; raises as `ask_s3`."""
    count = len(words.get("Body", b""))
    return ask_s3(url, lambda files: files._call_s3(call, **words), count)


def _stated(url: Url, answer: Mapping[str, Any], name: str) -> Any:
    """What an answer states, as those of S3 do."""
    if name not in answer:
        raise UnreachableError(f"{url}: the server's answer lacks {name}: it does not speak S3")
    return answer[name]


def _send(url: Url, call: str, data: bytes, **place: Any) -> Any:
    md5 = base64.b64encode(_md5(data).digest()).decode()
    return _asked(url, call, Body=data, ContentMD5=md5, **place)


def _parts(file: Path) -> Iterator[bytes]:
    size = max(PART, -(-file.stat().st_size // MOST_PARTS))
    with file.open("rb") as stream:
        while data := stream.read(size):
            yield data


def _is_of(stored: Stored, file: Path) -> bool:
    """Whether size and tag of an object are those that a file has once it was `_put`.

    A tag that is no MD5, as with some ways to encrypt, is that of no file.
    """
    if stored.size != file.stat().st_size:
        return False
    md5, each = _md5(), []
    for data in _parts(file):
        md5.update(data)
        each.append(_md5(data).digest())
    return stored.tag in (md5.hexdigest(), f"{_md5(b''.join(each)).hexdigest()}-{len(each)}")


def _same_bytes(url: Url, file: Path) -> bool:
    """Whether an object has the bytes of a file; all of it is read."""
    with contextlib.closing(open_store(url)) as store, file.open("rb") as near:
        same = all(block == near.read(len(block)) for block in store.blocks(0, store.size))
        return same and store.size == file.stat().st_size


def _md5(data: bytes = b"") -> Any:
    return hashlib.md5(data, usedforsecurity=False)


def _files(local: Path) -> dict[str, Path]:
    """The files of a result, by how its address goes on for each."""
    if local.is_dir():
        found = sorted(path for path in local.rglob("*") if path.is_file())
        return {f"/{path.relative_to(local).as_posix()}": path for path in found}
    if not local.is_file():
        raise UsageError(f"{local}: no such file or folder")
    notes = local.with_name(local.name + NOTES)
    return {"": local, **({NOTES: notes} if notes.is_file() else {})}


def _below(url: Url, rest: str) -> Url:
    return Url(url.address.rstrip("/") + rest)
