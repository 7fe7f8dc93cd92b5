"""What every `Form` of an export promises, as tests: say which it is.

class TestMine(FormContract):
    form = MINE
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.session import run
from recorder.cameras.stepped import ArraySource
from recorder.recording import record
from recorder.world.oscillatory import OscillatorySource
from replay.export.forms import Form
from replay.inputs import open_to_look

FRAMES, ITERATIONS = 12, 6


class FormContract:
    """The tests; a subclass names the form.

    Attributes:
        form: the form under test.
        options: words that its `write` is called with beside.
    """

    form: ClassVar[Form]
    options: ClassVar[dict[str, Any]] = {}

    @pytest.fixture
    def logged(self, tmp_path: Path) -> Iterator[Any]:
        """What the form is given: the folder of a run, or a recording of two views, opened."""
        folder = tmp_path / "logged"
        if self.form.of == "run":
            run(
                OscillatorySource(), LearnerConfig(), folder, max_iterations=ITERATIONS, rerun=False
            )
            yield folder
            return
        pictures = np.random.default_rng(0).integers(0, 255, (FRAMES, 16, 32), np.uint8)
        record(ArraySource({"left": pictures, "right": 255 - pictures}, fps=30), folder)
        with contextlib.closing(open_to_look([folder])) as source:
            yield source

    def test_it_writes_one_file_or_folder_and_says_how_much_there_is(
        self, logged: Any, tmp_path: Path
    ) -> None:
        out = tmp_path / "out"
        out.mkdir()
        options = {"lossless": True, **self.options} if self.form.lossy else self.options
        assert self.form.write(logged, out / "written", **options) > 0
        assert [path.name for path in out.iterdir()] == ["written"]
        assert self.form.unit

    def test_it_changes_nothing_of_what_was_logged(self, logged: Any, tmp_path: Path) -> None:
        folder = tmp_path / "logged"
        before = {path: path.read_bytes() for path in folder.iterdir()}
        options = {"lossless": False, **self.options} if self.form.lossy else self.options
        self.form.write(logged, tmp_path / "written", **options)
        assert {path: path.read_bytes() for path in folder.iterdir()} == before
