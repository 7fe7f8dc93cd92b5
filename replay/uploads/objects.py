"""One object of an S3 bucket: written in checked parts, and compared with the file it is of."""

from __future__ import annotations

import base64
import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import CdmisfaError
from replay.storage.identity import file_sha256
from replay.storage.limits import limits
from replay.storage.location import Url
from replay.storage.opening import open_store
from replay.storage.servers import ask_s3, s3_place

PART: Final = 16 * 1024 * 1024
"""Bytes of the parts in which a larger file is sent, each with its MD5, which the server checks."""

NOTES: Final = "-metadata.json"
"""What the name of notes that some exports have beside them has more."""

MOST_PARTS: Final = 10_000
"""Parts that an object may have."""


@dataclass(frozen=True, slots=True)
class Stored:
    """An object that is there: its size, and its entity tag, of most servers an MD5."""

    size: int
    tag: str


def objects_below(url: Url) -> dict[str, Stored]:
    """What is stored at an address, below it and beside it, by how its own address goes on.

    "" is the object itself, "/run.mcap" one below it, "-metadata.json" notes beside it.

    Raises:
        UsageError: there is no such bucket.
        UnreachableError: the server does not list it.
        CdmisfaError: what reads URLs is not installed.
    """
    bucket, key = s3_place(url)
    found: dict[str, Stored] = {}
    more: dict[str, str] = {}
    while True:
        words = {"Bucket": bucket, "Prefix": key, **more}
        answer = ask_s3(url, "list_objects_v2", limits().total, **words)
        for entry in answer.get("Contents", ()):
            rest = str(entry["Key"])[len(key) :]
            if rest in ("", NOTES) or rest.startswith("/"):
                found[rest] = Stored(int(entry["Size"]), str(entry["ETag"]).strip('"'))
        if not answer.get("IsTruncated"):
            return found
        more = {"ContinuationToken": answer["NextContinuationToken"]}


def put(file: Path, url: Url) -> None:
    """Write a file as an object, and see that the server has what was sent.

    Raises:
        UnreachableError: the server does not take it.
        CdmisfaError: the server has something else, or the file cannot be read.
    """
    bucket, key = s3_place(url)
    place = {"Bucket": bucket, "Key": key}
    size = file.stat().st_size
    if size <= PART:
        _send(url, "put_object", file.read_bytes(), **place)
    else:
        _put_parts(file, url, place)
    answer = ask_s3(url, "head_object", limits().total, **place)
    stored = Stored(int(answer["ContentLength"]), str(answer.get("ETag", "")).strip('"'))
    if not is_of(stored, file) and _sha256_behind(url, stored.size) != file_sha256(file):
        raise CdmisfaError(f"{url}: the server has other bytes than were sent")


def _put_parts(file: Path, url: Url, place: dict[str, Any]) -> None:
    begun = ask_s3(url, "create_multipart_upload", limits().total, **place)
    place = {**place, "UploadId": begun["UploadId"]}
    try:
        sent = [
            {
                "PartNumber": number,
                "ETag": _send(url, "upload_part", data, PartNumber=number, **place)["ETag"],
            }
            for number, data in enumerate(_parts(file), start=1)
        ]
        parts = {"Parts": sent}
        ask_s3(url, "complete_multipart_upload", limits().total, MultipartUpload=parts, **place)
    except BaseException:
        with contextlib.suppress(CdmisfaError):  # parts that nobody completes are paid for
            ask_s3(url, "abort_multipart_upload", limits().total, **place)
        raise


def _send(url: Url, call: str, data: bytes, **place: Any) -> Any:
    md5 = base64.b64encode(_md5(data).digest()).decode()
    return ask_s3(url, call, limits().of(len(data)), Body=data, ContentMD5=md5, **place)


def _parts(file: Path) -> Iterator[bytes]:
    size = max(PART, -(-file.stat().st_size // MOST_PARTS))
    with file.open("rb") as stream:
        while data := stream.read(size):
            yield data


def is_of(stored: Stored, file: Path) -> bool:
    """Whether size and tag of an object are those that a file has once it was `put`.

    A tag that is no MD5, as with some ways to encrypt, is that of no file.
    """
    if stored.size != file.stat().st_size:
        return False
    if "-" not in stored.tag:
        with file.open("rb") as stream:
            return stored.tag == hashlib.file_digest(stream, _md5).hexdigest()
    each = [_md5(data).digest() for data in _parts(file)]
    return stored.tag == f"{_md5(b''.join(each)).hexdigest()}-{len(each)}"


def _md5(data: bytes = b"") -> Any:
    return hashlib.md5(data, usedforsecurity=False)


def _sha256_behind(url: Url, size: int) -> str:
    """SHA-256 of an object, all of which is read."""
    with contextlib.closing(open_store(url)) as store:
        digest = hashlib.sha256()
        for block in store.blocks(0, size) if size else ():
            digest.update(block)
    return digest.hexdigest()
