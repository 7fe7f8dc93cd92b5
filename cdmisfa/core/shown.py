"""What a notebook shows of an object: a table of facts and a small picture."""

from __future__ import annotations

import base64
import html
import io
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTH = 480
"""Most pixels across of a picture, as a rule."""

ROW = 24
"""Pixels of the height of a row in a picture."""

MOST = 200
"""Frames of numbers that a picture shows."""

MOST_STREAMS = 6
"""Streams of images that it shows."""


class Shown:
    """An object with a short text, and a table and a small picture in a notebook."""

    __slots__ = ()

    @abstractmethod
    def _facts(self) -> Mapping[str, Any]:
        """What is told of it, by names."""

    def _picture(self) -> NDArray[np.uint8] | None:
        """A picture (height, width) or (height, width, 3), if it has one."""
        return None

    def __repr__(self) -> str:
        first, *rest = self._facts().items()
        facts = "".join(f", {name} {value}" for name, value in rest)
        return f"<{type(self).__name__} {first[1]}{facts}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f'<tr><th style="text-align:left">{html.escape(name)}</th>'
            f'<td style="text-align:left">{html.escape(str(value))}</td></tr>'
            for name, value in self._facts().items()
        )
        picture = self._picture()
        image = (
            "" if picture is None else f'<img alt="" src="data:image/png;base64,{png(picture)}">'
        )
        return f"<div><table>{rows}</table>{image}</div>"


def beside(frames: list[NDArray[Any]]) -> NDArray[np.uint8]:
    """Frames of images side by side, no wider than `WIDTH` together; one at least."""
    wide = np.hstack(frames)
    step = -(-wide.shape[1] // WIDTH)
    return np.ascontiguousarray(wide[::step, ::step])


def curves(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Numbers (n, I) over time, each in a shade, from the least to the most of all."""
    picture = np.full((4 * ROW, WIDTH), 255, np.uint8)
    low, high = float(values.min()), float(values.max())
    places = np.linspace(0, WIDTH - 1, len(values)).astype(int)
    scale = (len(picture) - 1) / (high - low) if high > low else 0.0
    for i, line in enumerate(values.T):
        heights = np.rint((high - line) * scale).astype(int)
        across = np.arange(WIDTH)
        shade = 160 * i // values.shape[1]
        picture[np.interp(across, places, heights).astype(int), across] = shade
    return picture


def weights(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Weights (rows, columns), blue below 0, white 0, orange above, the largest in full colour."""
    most = float(np.abs(values).max()) or 1.0
    rest = np.rint(255 * (1 - np.abs(values) / most)).astype(np.uint8)
    full, below = np.full_like(rest, 255), values < 0
    picture = np.stack([np.where(below, rest, full), rest, np.where(below, full, rest)], axis=2)
    across = max(WIDTH // picture.shape[1], 1)
    down = across if len(picture) > 1 else ROW
    return np.repeat(np.repeat(picture, down, axis=0), across, axis=1)


def png(picture: NDArray[np.uint8]) -> str:
    """A picture as a PNG file, in base64."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    return base64.b64encode(data.getvalue()).decode()
