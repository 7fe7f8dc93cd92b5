"""The sample logs: which there are, where they lie, and fetching those that are in no wheel.

The recording of the iCub is under CC BY-SA 4.0, a wheel under Apache-2.0: each of its logs is an
attachment of a release instead, as `icub-left.mcap` is `icub/left.mcap`.
"""

from __future__ import annotations

import hashlib
import http.client
import re
import shutil
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from threading import Thread
from typing import Any, Final

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError, one_line
from recorder.log.files import atomic_write
from replay.storage.location import Url, limits, location
from replay.storage.servers import UnreachableError

CARD: Final = "README.md"
"""What says of the samples how they were made, their licences, and what they are to the byte."""

ADDRESS: Final = "Samples"
"""Name of the URL in the metadata of the package that says where a release's attachments are."""

_LOG: Final = re.compile(
    r"^\| `([a-z0-9/]+\.mcap)` \| ([\d,]+) \| `([0-9a-f]{64})` \|$", re.MULTILINE
)


@dataclass(frozen=True, slots=True)
class Log:
    """A log of a sample: its size in bytes, and its SHA-256."""

    size: int
    sha256: str


def samples_here() -> Path:
    """The folder of the samples that came with this package, or of all in a checkout."""
    installed, checkout = (Path(__file__).parents[n] / "sample_logs" for n in (1, 2))
    return installed if installed.is_dir() else checkout


def logs() -> Mapping[str, Log]:
    """The logs of all samples by their names, as "icub/left.mcap"."""
    card = (samples_here() / CARD).read_text("utf-8")
    return {
        name: Log(int(size.replace(",", "")), sha256) for name, size, sha256 in _LOG.findall(card)
    }


def gather(
    out: Path, address: str | None = None, progress: Callable[[int, int], None] = lambda *_: None
) -> None:
    """Write all samples into a folder, those first that need no network.

    Args:
        out: the folder; logs of the samples that it holds stay as they are.
        address: http or https address of the attachments; by default that of the release.
        progress: told how many logs of how many are there.

    Raises:
        UsageError: the folder holds something else by a log's name, or this is no address.
        UnreachableError: a log cannot be fetched.
        LogDamagedError: what was fetched is something else.
        CdmisfaError: no address is known.
    """
    known, here = logs(), samples_here()
    if not (out / CARD).exists():
        with atomic_write(out / CARD) as partial:
            shutil.copyfile(here / CARD, partial)
    order = sorted(known, key=lambda name: not (here / name).is_file())
    for done, name in enumerate(order):
        target, log = out / name, known[name]
        progress(done, len(order))
        if target.exists():
            same = target.is_file() and target.stat().st_size == log.size
            if not (same and _sha256(target.read_bytes()) == log.sha256):
                raise UsageError(f"{target} is not that sample: remove it or name another folder")
            continue
        own = here / name
        data = own.read_bytes() if own.is_file() else _fetched(address, name, log.size, target)
        if _sha256(data) != log.sha256:
            raise LogDamagedError(
                f"{name}: what came is something else than the sample (its SHA-256 differs)"
            )
        with atomic_write(target) as partial:
            partial.write_bytes(data)


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _fetched(address: str | None, name: str, size: int, target: Path) -> bytes:
    """The bytes of an attachment, at most one more than there shall be."""
    address = address or _stated()
    if address is None:
        raise CdmisfaError(
            f"{name} is in no wheel, and this package states no address of its release's "
            "attachments: give it with --url"
        )
    place = location(f"{address.rstrip('/')}/{name.replace('/', '-')}")
    if not isinstance(place, Url) or place.scheme == "s3":
        raise UsageError(f"{address} is no http address: the attachments of a release are at one")
    coming: Future[bytes] = Future()
    # What dribbles in is ended by no timeout of a socket: a thread can be left behind.
    Thread(target=_answer, args=(coming, place.address, limits().read, size), daemon=True).start()
    try:
        return coming.result(limits().of(size))
    except TimeoutError:
        why = "the server does not answer in time"
    except (OSError, http.client.HTTPException, ValueError) as error:
        why = one_line(getattr(error, "reason", None) or error)
    raise UnreachableError(f"{place}: {why}; fetched elsewhere, it belongs to {target}")


def _stated() -> str | None:
    """Where the metadata of this package say that its release's attachments are."""
    stated = metadata.metadata("cdmisfa").get_all("Project-URL") or ()
    return dict(one.split(", ", 1) for one in stated).get(ADDRESS)


def _answer(coming: Future[bytes], address: str, seconds: float, size: int) -> None:
    try:
        with urllib.request.build_opener(_Redirects).open(address, timeout=seconds) as answer:
            coming.set_result(answer.read(size + 1))
    except Exception as error:
        if isinstance(error, urllib.error.HTTPError):
            error.close()  # it holds the connection
        coming.set_exception(error)


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Ten at most, to no other kind of address, and from https to https alone."""

    def redirect_request(self, req: Any, fp: Any, *answer: Any) -> Any:
        kind = answer[-1].partition(":")[0].lower()
        if kind not in ("https", req.type):
            fp.close()
            raise ValueError(f"the server sends us to an address of {kind}")
        return super().redirect_request(req, fp, *answer)
