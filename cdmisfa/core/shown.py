"""Objects in a notebook: a table of facts, and a small image where there is one."""

from __future__ import annotations

import base64
import html
import io
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Largest width of an image, as a rule, and height of one of its rows, in pixels.
WIDTH = 480
ROW = 24


class Shown:
    """An object with a short text, and a table and a small image in a notebook."""

    __slots__ = ()

    @abstractmethod
    def _facts(self) -> Mapping[str, Any]:
        """Return facts about the object, by names."""

    def _picture(self) -> NDArray[np.uint8] | None:
        """Return an image (height, width) or (height, width, 3), if there is one."""
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
        image = ""
        if (picture := self._picture()) is not None:
            from PIL import Image

            data = io.BytesIO()
            Image.fromarray(picture).save(data, "PNG")
            png = base64.b64encode(data.getvalue()).decode()
            image = f'<img alt="" src="data:image/png;base64,{png}">'
        return f"<div><table>{rows}</table>{image}</div>"


def weights(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return an image of weights: blue below 0, white 0, orange above, the largest in full colour.

    Args:
        values: (rows, columns).
    """
    largest = float(np.abs(values).max()) or 1.0
    rest = np.rint(255 * (1 - np.abs(values) / largest)).astype(np.uint8)
    full, below = np.full_like(rest, 255), values < 0
    picture = np.stack([np.where(below, rest, full), rest, np.where(below, full, rest)], axis=2)
    across = max(WIDTH // picture.shape[1], 1)
    down = across if len(picture) > 1 else ROW
    return np.repeat(np.repeat(picture, down, axis=0), across, axis=1)
