"""The examples do what they say."""

from __future__ import annotations

import runpy
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from contracts.learners import SinkContract
from tensorboardX.proto.event_pb2 import Event

import cdmisfa
from cdmisfa.core.learning import Learner
from recorder.world.oscillatory import OscillatorySource

TENSORBOARD = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "tensorboard_sink.py"))


class TestTensorBoard(SinkContract):
    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> cdmisfa.Sink:
        sink: cdmisfa.Sink = TENSORBOARD["TensorBoard"](str(folder))
        return sink


def values(folder: Path) -> Iterator[Any]:
    """What an event file holds: records of a length, its checksum, an event and its checksum."""
    (file,) = folder.iterdir()
    data = file.read_bytes()
    while data:
        size = struct.unpack_from("<Q", data)[0]
        event = Event.FromString(data[12 : 12 + size])
        yield from ((event.step, value) for value in event.summary.value)
        data = data[16 + size :]


def test_tensorboard_has_the_curves_and_events_of_a_run(tmp_path: Path) -> None:
    sink = TENSORBOARD["TensorBoard"](str(tmp_path / "curves"))
    run = cdmisfa.learn("oscillatory", max_modules=1, sinks=[sink])
    written = list(values(tmp_path / "curves"))
    for name in ("reward", "epsilon", "stream"):
        points = [(step, value.simple_value) for step, value in written if value.tag == name]
        signal = np.asarray(run.signals[name], float)
        known = np.flatnonzero(np.isfinite(signal))
        assert [step for step, _ in points] == known.tolist()
        np.testing.assert_allclose([y for _, y in points], signal[known], rtol=1e-6)
    reported = [
        value.tensor.string_val[0] for _, value in written if value.tag.startswith("events")
    ]
    assert any(b"module 1 saved" in text for text in reported)
