"""Colors that people with any color vision can tell apart, for the viewer and figures.

The figures that redraw the paper's panels have their own colors.

Source: Okabe and Ito, Color Universal Design (2008).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]
Rgba = tuple[int, int, int, int]
RgbOrRgba = Rgb | Rgba

ORANGE: Rgb = (230, 159, 0)
SKY: Rgb = (86, 180, 233)
GREEN: Rgb = (0, 158, 115)
YELLOW: Rgb = (240, 228, 66)
BLUE: Rgb = (0, 114, 178)
VERMILLION: Rgb = (213, 94, 0)
PURPLE: Rgb = (204, 121, 167)
GREY: Rgb = (136, 136, 136)

# Colors of streams, and of what belongs to one.
CYCLE: tuple[Rgb, ...] = (SKY, ORANGE, GREEN, PURPLE, YELLOW, VERMILLION, BLUE)

SAND: Rgb = (190, 180, 130)
MIST: Rgb = (165, 180, 195)
DARK: Rgb = (85, 85, 85)

ROSE: Rgb = (214, 170, 165)
LILAC: Rgb = (175, 160, 205)
MOSS: Rgb = (135, 155, 115)
KHAKI: Rgb = (150, 140, 95)
STEEL: Rgb = (140, 150, 160)
PLUM: Rgb = (155, 130, 185)
CLAY: Rgb = (195, 140, 130)
BRICK: Rgb = (190, 95, 90)
BROWN: Rgb = (140, 115, 95)

# Colors of the states of streams: not decided, learned, explained, rejected; no stream has one.
STATE_COLOURS: tuple[Rgb, ...] = (SAND, PLUM, MIST, DARK)

# Colors of lines that belong to no stream: a full color is a stream's, and its module's. They are
# seen on black, and on the white on which browsers show the viewer.
PALE: tuple[Rgb, ...] = (STEEL, KHAKI, PLUM, MOSS, CLAY, BROWN)

# Shades between white and a full color: as many as eight bits distinguish.
STEPS = 255


def colour(index: int) -> Rgb:
    """Return the color of stream number `index`, from 0."""
    return CYCLE[index % len(CYCLE)]


def pale(index: int) -> Rgb:
    """Return the color of line number `index`, from 0, that belongs to no stream."""
    return PALE[index % len(PALE)]


def faint(rgb: Rgb) -> Rgba:
    """Return a half transparent color, which is readable on black and on white."""
    return (*rgb, 0x80)


def packed(rgb: RgbOrRgba) -> int:
    """Return a color as 0xRRGGBBAA."""
    red, green, blue, *opacity = rgb
    return red << 24 | green << 16 | blue << 8 | (opacity[0] if opacity else 0xFF)


def packed_all(colours: Sequence[RgbOrRgba]) -> NDArray[np.uint32]:
    """Return colors as an (n,) array, the form that the viewer accepts for any n."""
    return np.array([packed(rgb) for rgb in colours], dtype=np.uint32)


def shade(weights: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return weights as an image: blue below zero, white at zero, vermillion above.

    Args:
        weights: (height, width); the largest magnitude gets the full color.

    Returns:
        (height, width, 3) uint8.
    """
    largest = float(np.max(np.abs(weights), initial=0.0))
    if not 0 < largest < np.inf:
        return np.broadcast_to(_SHADES[STEPS], (*weights.shape, 3)).copy()
    return _SHADES[np.rint(weights * (STEPS / largest)).astype(np.intp) + STEPS]


def _shades() -> NDArray[np.uint8]:
    """Return (2 STEPS + 1, 3) colors from blue over white to vermillion."""
    part = np.linspace(-1.0, 1.0, 2 * STEPS + 1)[:, None]
    white = np.array([255.0, 255.0, 255.0])
    low, high = np.array(BLUE, dtype=float), np.array(VERMILLION, dtype=float)
    image = np.where(part < 0, white + (low - white) * -part, white + (high - white) * part)
    return np.asarray(np.round(image), dtype=np.uint8)


_SHADES = _shades()
