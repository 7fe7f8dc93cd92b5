"""Resolve the location of a log: a path, or a URL that is copied to this machine by fsspec."""

from __future__ import annotations

import atexit
import functools
import hashlib
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import CdmisfaError, MissingPackageError, UsageError, needs, one_line

SCHEMES: Final = ("s3", "http", "https")

# Environment variable with the folder of copies, so that processes started here share it.
COPIES: Final = "CDMISFA_COPIES"

# User name and password, query and fragment of a URL: messages must not repeat them.
_SECRET: Final = re.compile(r"(?<=://)[^/@]*@|[?#].*")

# Longest time without data from a web server (s). aiohttp's default, 300 s for a whole copy, ends
# large copies.
_SILENT_SECONDS: Final = 60.0


def is_url(word: str | Path) -> bool:
    """Return whether a word names a log on a server."""
    return isinstance(word, str) and "://" in word


def location(word: str | Path) -> Path:
    """Return a path as it is, and for a URL the path of a copy.

    The copy is made once and removed when the process ends.

    Raises:
        UsageError: the word is empty, the scheme of the URL is not supported, or a package that
            reads URLs is missing.
        CdmisfaError: the server does not deliver the log.
    """
    if not is_url(word):
        if word == "":
            raise UsageError("an argument is empty: give a path or a URL")
        return Path(word)
    return _copied(str(word))


def with_urls(text: str) -> str:
    """Return a text in which the paths of copies are replaced by their URLs."""
    folder = os.environ.get(COPIES)
    if folder is None or folder not in text:
        return text
    return re.sub(rf"{re.escape(folder)}/\w+/({'|'.join(SCHEMES)})/", r"\1://", text)


@functools.cache
def _copied(address: str) -> Path:
    """Copy the log at a URL, and return the path of the copy."""
    public_url = _SECRET.sub("", address)
    scheme, _, place = public_url.partition("://")
    if scheme not in SCHEMES:
        raise UsageError(f"{scheme}:// is not supported: use {', '.join(SCHEMES)}, or a path")
    key = hashlib.sha256(address.encode()).hexdigest()[:16]
    parts = [part for part in place.split("/") if part not in ("", ".", "..")]
    package = "s3fs" if scheme == "s3" else "aiohttp"  # fsspec's own, which it does not require
    target = _folder().joinpath(key, scheme, *parts)
    try:
        with needs(f"{public_url}: not read", package, "'cdmisfa[cloud]'"):
            _copy(scheme, address, target)
    except MissingPackageError:
        raise
    except FileNotFoundError:
        raise CdmisfaError(f"{public_url}: no such file") from None
    except Exception as error:  # whatever fsspec's file systems raise
        reason = one_line(error).replace(address, public_url)
        raise CdmisfaError(f"{public_url}: {reason}") from error
    return target


def _copy(scheme: str, address: str, target: Path) -> None:
    """Copy a file, or the logs right below an S3 prefix, unless another process has done so."""
    import fsspec

    if target.exists():
        return
    options: dict[str, Any] = {}
    if scheme != "s3":
        import aiohttp

        options["client_kwargs"] = {
            "timeout": aiohttp.ClientTimeout(total=None, sock_read=_SILENT_SECONDS)
        }
    files = fsspec.filesystem(scheme, **options)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=_folder())) / target.name
    if scheme == "s3" and files.isdir(address):
        partial.mkdir()
        for name in files.ls(address, detail=False):
            if name.endswith((".mcap", ".mcap.partial")):
                files.get_file(name, str(partial / name.rpartition("/")[2]))
    else:
        files.get_file(address, str(partial))
    partial.rename(target)


def _folder() -> Path:
    """Return the folder of copies."""
    if COPIES not in os.environ:
        os.environ[COPIES] = tempfile.mkdtemp(prefix="cdmisfa-")
        atexit.register(shutil.rmtree, os.environ[COPIES], ignore_errors=True)
    return Path(os.environ[COPIES])
