"""Checks of what logs hold, made while their chunks are decoded."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.signals import SignalsHash
from cdmisfa.core.untrusted import read_regular
from recorder.images.messages import Decoder
from recorder.images.options import IMAGES
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Problem, Segment
from replay.camera_logs.mcap_log import channels_on, topics_in
from replay.camera_logs.stream import explained, sorted_times
from replay.integrity.info import as_problem
from replay.recordings.view_file import ViewFile
from replay.runs.folders import FINAL_METADATA, MODULES_FILE, RUN_JSON, VIEW_FILE, read_run_json
from replay.runs.log import SIGNALS_TOPIC, Batch, BatchReader, header_in
from replay.runs.modules import load_modules
from replay.runs.provenance import facts_sha256
from replay.storage.arrays import MAX_BYTES


class RunPass:
    """Checks a run against what it states while the chunks of its log are decoded.

    Args:
        log: of the run, whole.
        reader: of the log.
        beside: also look at the files beside it.
    """

    def __init__(self, log: Path, reader: LogReader, *, beside: bool) -> None:
        self._log, self._reader, self._beside = log, reader, beside
        self._final = next((r.metadata for r in reader.metadata if r.name == FINAL_METADATA), None)
        self._document = read_run_json(log.parent) if beside else {}
        self._stated = self._stated_signals()
        self._hash, self._expected = SignalsHash(), 0
        self._batches: BatchReader | None = None
        self._found: list[Problem] = []
        with self._catching():
            header = header_in(reader)
            if self._stated is not None:
                self._batches = BatchReader(log, header, reader.channels, topics=(SIGNALS_TOPIC,))

    def add(self, segment: Segment) -> None:
        """Check the next chunk of the log."""
        table = self._reader.table(segment)
        with self._catching():
            if self._batches is not None and table is not None:
                for batch in self._batches.take(table):
                    self._add(batch)

    def finish(self) -> None:
        """Compare the signals with what the run states, after the last chunk."""
        with self._catching():
            if self._batches is not None:
                self._add(self._batches.rest())
                if self._hash.hexdigest() != self._stated:
                    what = f"its {self._hash.count} iterations are not those that the run had"
                    self._found.append(Problem(str(self._log), what))

    def problems(self) -> Iterator[Problem]:
        """Where the run is not what it states, of a log that is whole."""
        yield from self._found
        final, folder = self._final, self._log.parent
        if final is None or not self._beside:
            return
        if not self._document:
            yield Problem(str(folder / RUN_JSON), "is missing, empty or no JSON")
        elif facts_sha256(self._document) != final.get("facts_sha256"):
            what = "states something else than the run's final record"
            yield Problem(str(folder / RUN_JSON), what)
        yield from _check_modules(folder / MODULES_FILE, final.get("modules_sha256"))
        view = folder / VIEW_FILE
        if final.get("view") == json.dumps(True) and not view.is_file():
            yield Problem(str(view), f"is missing; {view_again(folder)}")

    def notes(self) -> Iterator[str]:
        """What nothing proves."""
        folder = self._log.parent
        if self._beside and (view := folder / VIEW_FILE).is_file():
            yield f"{view} is not checked: {view_again(folder)}"
        if self._final is None:
            yield f"{self._log} holds no final record: nothing proves what is beside it"

    def _stated_signals(self) -> Any:
        """SHA-256 of its signals as it states it, None where it does not."""
        if self._final is not None:
            return self._final.get("signals_sha256")
        result = self._document.get("result")
        return result.get("signals_sha256") if isinstance(result, Mapping) else None

    def _add(self, batch: Batch) -> None:
        for signals in (record for columns in batch.signals for record in columns.records()):
            if signals.iteration != self._expected:
                what = f"iterations {self._expected} to {signals.iteration - 1} are missing"
                self._found.append(Problem(str(self._log), what))
            self._expected = signals.iteration + 1
            self._hash.add(signals)

    @contextlib.contextmanager
    def _catching(self) -> Iterator[None]:
        try:
            yield
        except CdmisfaError as error:
            self._found.append(as_problem(self._log, error))
            self._batches = None


def view_again(run: Path) -> str:
    """How the view of a run comes back; it holds nothing that the log does not."""
    command = ("cdmisfa", "view", str(run), "--save", str(run / VIEW_FILE), "--force")
    return f"make it again with {shlex.join(command)}"


def _check_modules(path: Path, stated: str | None) -> Iterator[Problem]:
    try:
        if not path.is_file():
            yield Problem(str(path), "is missing")
        elif hashlib.sha256(read_regular(path, MAX_BYTES)).hexdigest() != stated:
            yield Problem(str(path), "holds something else than the run's final record states")
        else:
            load_modules(path)
    except CdmisfaError as error:
        yield as_problem(path, error)


class ViewPass:
    """Checks the frames of one file of a recording while its chunks are decoded."""

    def __init__(self, path: Path, reader: LogReader) -> None:
        self.path = path
        self.view: ViewFile | None = None
        self.error: LogDamagedError | None = None
        with self._catching():
            self.view = ViewFile(path, reader=reader)

    def add(self, segment: Segment) -> None:
        with self._catching():
            if self.view is not None and self.error is None:
                self.view.check_chunk(segment)

    def finish(self) -> None:
        with self._catching():
            if self.view is not None:
                self.view.finish()

    @contextlib.contextmanager
    def _catching(self) -> Iterator[None]:
        try:
            yield
        except LogDamagedError as error:
            self.error = error


class ImagesPass:
    """Decodes the images of an external log while its chunks are decoded.

    It raises if one is broken: then the log is read again.
    """

    def __init__(self, path: Path, reader: LogReader) -> None:
        self._path, self._reader = path, reader
        self._decoders: dict[int, Decoder] = {}
        for topic in topics_in(reader, IMAGES):
            channels, decode = channels_on(reader, topic, IMAGES)
            self._decoders |= dict.fromkeys((channel.id for channel in channels), decode)

    def add(self, segment: Segment) -> None:
        table = self._reader.table(segment)
        assert table is not None
        rows = np.flatnonzero(np.isin(table.channel, list(self._decoders)))
        if len(rows):
            sorted_times(str(self._path), np.sort(table.log_time[rows]))
        with explained(self._path, "its decoder", held=table.data.nbytes):
            for row in rows.tolist():
                self._decoders[int(table.channel[row])](table.view(row))

    def finish(self) -> None:
        """Nothing is left to check."""
