"""What every `Camera` promises, as tests: say what to open.

class TestMine(CameraContract):
    def open(self) -> Camera:
        return MyCamera("mine:0", "mine")
"""

from __future__ import annotations

import itertools
import json

import numpy as np

from recorder.cameras.readers import Camera


class CameraContract:
    """The tests; a subclass gives a camera that is not opened yet in `open`.

    Attributes:
        count: pictures that are waited for.
    """

    count = 3

    def open(self) -> Camera:
        """Make a camera of the kind under test."""
        raise NotImplementedError

    def test_its_pictures_are_of_one_kind_and_no_older_than_now(self) -> None:
        taken = list(itertools.islice(self.open().pictures(), self.count))
        assert len(taken) == self.count
        for age, image in taken:
            assert age >= 0
            if image.ndim == 1:
                assert image.dtype == np.float64, "numbers are (I,) float64"
                assert np.isfinite(image).all(), "numbers are finite"
            else:
                assert image.dtype == np.uint8
                assert image.shape[2:] in ((), (3,)), "gray (height, width), or with 3 colours"
            assert image.size
        assert len({(image.ndim, image.shape[2:]) for _, image in taken}) == 1
        assert len({image.shape for _, image in taken if image.ndim == 1}) <= 1

    def test_it_can_be_opened_again(self) -> None:
        camera = self.open()
        for _ in range(2):  # as after a loss
            pictures = camera.pictures()
            assert next(iter(pictures))[1].size
            if hasattr(pictures, "close"):
                pictures.close()

    def test_its_description_is_json(self) -> None:
        camera = self.open()
        described = dict(camera.describe())
        assert json.loads(json.dumps(described)) == described
        assert camera.name
        assert isinstance(camera.finite, bool)
        assert camera.rate is None or camera.rate > 0
