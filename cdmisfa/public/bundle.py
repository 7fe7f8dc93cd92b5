"""A run in one file, for others to check: an RO-Crate of the run and what it learned from."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, NotReproducedError, UsageError
from cdmisfa.core.untrusted import MAX_LIST, begun, parse_json
from cdmisfa.experiments.documents import as_text
from cdmisfa.experiments.recompute import Recomputation
from cdmisfa.experiments.resume import read_command
from cdmisfa.public.crate import LEARNED, METADATA, RUN, SOURCE, About, description
from recorder.log.files import atomic_write, refuse_taken, refuse_unless
from recorder.world.scenes import SCENES
from replay.arrays import ENDINGS
from replay.camera_logs.opening import image_logs
from replay.corpus.finding import may_be_corpus
from replay.inputs import locations
from replay.integrity.verify import check_logs
from replay.runs.folders import MODULES_FILE, RUN_FILE, RUN_JSON, run_log
from replay.storage.location import Url
from replay.storage.packed import Package, Packed, Packer, opened_package

_FILES: Final = (RUN_FILE, RUN_JSON, MODULES_FILE)
_ZIP: Final = b"PK\x03\x04"


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle that was written.

    Attributes:
        files: in it, besides its description.
        source: "included", or "hashes" where what the run learned from is stated alone, or "scene"
            where that is computed.
    """

    path: Path
    files: tuple[Packed, ...]
    source: str

    def as_json(self) -> dict[str, Any]:
        """The same as JSON values."""
        files = [{"file": f.name, "bytes": f.size, "sha256": f.sha256} for f in self.files]
        bytes_ = self.path.stat().st_size
        return {"bundle": str(self.path), "bytes": bytes_, "source": self.source, "files": files}


def write_bundle(
    run: str | Path,
    out: str | Path,
    *,
    source: Sequence[str] = (),
    with_source: bool = True,
    about: About | None = None,
    force: bool = False,
    told: Callable[[int, int], None] = lambda done, size: None,
) -> Bundle:
    """Write a finished run, with what it learned from, as one file that others can check.

    The same run gives the same bytes.

    Args:
        run: its folder, or its log.
        out: the file, *.zip.
        source: words that name what it learned from, where it is not what the run says.
        with_source: include that; else its hashes are stated, as they are of what URLs name.
        about: what the bundle says of itself.
        force: replace an existing file.
        told: of the bytes that were packed, and of how many there are.

    Raises:
        UsageError: there is no such run or source, or the run is not finished.
        LogDamagedError: the run is damaged.
        NotReproducedError: the source is not that which the run learned from.
        LogWriteError: the file cannot be written.
    """
    folder, out, about = run_log(Path(run)).parent, Path(out), about or About()
    refuse_unless(out, "a bundle is a zip file", ".zip")
    refuse_taken(out, force=force)
    if not (folder / RUN_FILE).is_file():
        raise UsageError(f"{run} is no run: name the folder that learn wrote")
    if missing := [name for name in _FILES if not (folder / name).is_file()]:
        raise UsageError(f"{folder} has no {missing[0]}: finish it with learn --resume")
    if (state := check_logs(folder).state) != "whole":
        raise LogDamagedError(f"{folder}: {state}, see cdmisfa verify")
    members = {RUN + name: folder / name for name in _FILES}
    words, kind = (_source_files(folder, source) if with_source else {}), "hashes"
    if words:
        kind = "included"
    elif _is_scene(folder, source):
        kind = "scene"
    members |= {name: path for files in words.values() for name, path in sorted(files.items())}
    size, done = sum(path.stat().st_size for path in members.values()), 0

    def packed_more(count: int) -> None:
        nonlocal done
        done += count
        told(done, size)

    with atomic_write(out) as partial, Packer(partial) as packer:
        files = [packer.add(name, path, packed_more) for name, path in members.items()]
        text = as_text(description(folder, files, tuple(words), about))
        if len(text) > MAX_LIST:
            raise UsageError(
                f"{folder} learned from {len(files)} files, too many to be listed: make a "
                "recording of them with cdmisfa convert, or use --no-source"
            )
        packer.add_text(METADATA, text)
    return Bundle(out, tuple(files), kind)


def is_bundle(path: Path) -> bool:
    """Whether a path is that of a bundle, or of a file that can only be meant as one.

    Arrays of NumPy are zip files, too.
    """
    ending = path.suffix.lower()
    return path.is_file() and (
        ending == ".zip" or (ending not in ENDINGS and begun(path).startswith(_ZIP))
    )


@contextlib.contextmanager
def opened_bundle(path: Path, source: Sequence[str] = ()) -> Iterator[tuple[Path, tuple[str, ...]]]:
    """The run in a bundle, and words that name what it learned from; both go with the context.

    Every file is compared with the hash that the bundle states of it. What the run says of where it
    learned from is not followed, but for a scene: it may be a bundle of somebody else.

    Args:
        path: of the bundle.
        source: words that name the source, where it is not the bundle's.

    Raises:
        UsageError: it is no bundle of a run, or has no source and none is named.
        LogDamagedError: it is damaged or was changed.
        CdmisfaError: there is no room for what is in it.
    """
    with tempfile.TemporaryDirectory(prefix="cdmisfa-") as temporary:
        folder = Path(os.path.realpath(temporary))
        try:
            with opened_package(path) as package:
                words = _unpacked(package, folder)
            named = tuple(source) or tuple(str(folder / word) for word in words)
            if not named and not _is_scene(folder / RUN):
                raise UsageError(
                    f"{path} holds hashes of what the run learned from, not that itself: name it "
                    "with --source"
                )
            yield folder / RUN, named
        except CdmisfaError as error:
            error.args = (str(error).replace(str(folder), str(path)),)
            raise


def _is_scene(run: Path, source: Sequence[str] = ()) -> bool:
    """Whether what a run learned from is computed."""
    words = tuple(source)
    if not words:
        try:
            words = read_command(run)[0]
        except UsageError:
            return False
    return all(word in SCENES for word in words)


def _source_files(run: Path, source: Sequence[str]) -> dict[str, dict[str, Path]]:
    """The files that a run learned from, of each path that names some, by their names in a bundle.

    Raises:
        UsageError: there are none such.
        NotReproducedError: they are others.
    """
    with Recomputation(run, 0, source) as again:
        again.source  # noqa: B018, it is opened when it is asked for
        if others := again.other_files():
            raise NotReproducedError(
                f"{', '.join(others)}: no longer what {run} learned from; name that with --source"
            )
    if _is_scene(run, source):
        return {}
    named = locations(tuple(source) or read_command(run)[0])
    places = [Path(os.path.abspath(place)) for place in named if not isinstance(place, Url)]
    if len(places) < len(named):
        return {}  # what a URL names stays there
    above = os.path.commonpath([place.parent for place in places])
    found = {}
    for place in places:
        logs = [place] if may_be_corpus([str(place)]) else image_logs([place])
        files = itertools.chain.from_iterable(map(_files_of, logs))
        word = SOURCE + os.path.relpath(place, above) + ("/" if place.is_dir() else "")
        found[word] = {SOURCE + os.path.relpath(file, above): file for file in files}
    return found


def _files_of(place: Any) -> list[Path]:
    """A file, or all that are in a folder or below."""
    if place.is_file():
        return [place]
    return [file for file in sorted(place.rglob("*")) if file.is_file()]


def _unpacked(package: Package, folder: Path) -> list[str]:
    """Unpack all files of a bundle, and compare them with their hashes: the words of its source.

    Raises:
        UsageError: it is no bundle of a run.
        LogDamagedError: it is damaged or was changed.
        CdmisfaError: there is no room for it.
    """
    path = package.path
    if METADATA not in package.sizes:
        raise UsageError(f"{path} holds no {METADATA}: it is no bundle of cdmisfa bundle")
    try:
        graph = parse_json(package.read(METADATA, MAX_LIST), MAX_LIST)["@graph"]
        entities = {unquote(str(entity["@id"])): entity for entity in graph}
        stated = {name: entities.get(name, {}).get("sha256") for name in package.sizes}
        named = [unquote(str(ref["@id"])) for ref in entities[LEARNED]["object"]]
        kept = {name for name, found in entities.items() if found["@type"] == "File"}
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise LogDamagedError(f"{path}: {METADATA} does not describe the run in it") from error
    del stated[METADATA]
    for name in (*(RUN + name for name in _FILES), *sorted(kept)):
        if name not in stated:
            raise LogDamagedError(f"{path}: {name} is missing")
    size, room = sum(package.sizes.values()), shutil.disk_usage(folder).free
    if size > room:
        raise CdmisfaError(
            f"{path}: it has {size} bytes, and there is room for {room} at {folder.parent}: set "
            "TMPDIR"
        )
    for name, sha256 in stated.items():
        if sha256 is None:
            raise LogDamagedError(f"{path}: {METADATA} knows nothing of {name}")
        try:
            found = package.unpack(name, folder / name)
        except OSError as error:
            raise CdmisfaError(f"{path}: {name} cannot be unpacked: {error.strerror}") from None
        if found.sha256 != sha256:
            raise LogDamagedError(f"{path}: {name} was changed: it is not what was bundled")
    return [
        word
        for word in named
        if word in stated or (word.endswith("/") and any(name.startswith(word) for name in stated))
    ]
