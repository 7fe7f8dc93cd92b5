"""Columns of images: frozen, black, blurred, moved, or of other colors than all others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from cdmisfa.core.arrays import FloatArray
from replay.episodes.measure import CameraMeasures, Measured, period
from replay.episodes.numbers import Column, column, longest, paths, scaled

# Share of the median change of images in motion below which an image is the same.
SAME: Final = 0.1

# Images before and after one that it is compared with, and the share of the median change in motion
# that they must have: codecs show slow motion in jumps, and of a still scene nothing can be told.
AROUND: Final = 5
SEEN: Final = 0.8

# Time between two images from which on some are missing, in their median time.
PAUSE: Final = 1.5

# Share of black pixels from which on nothing else is told of an image.
DARK: Final = 0.8

# Blocks down and across in which a shift must explain the difference of two views, and their share.
BLOCKS: Final = (6, 8)
EXPLAINED: Final = 0.33


def columns_of_images(episodes: Sequence[Measured], camera: str) -> list[Column]:
    """Return the columns of the images of a camera that all episodes have."""
    cameras = [episode.cameras[camera] for episode in episodes]
    steps = None
    if moving := scaled(episodes, "action") or scaled(episodes, "state"):
        path, speed = paths(moving)
        clocks = zip(cameras, moving, path, strict=True)
        reached = [np.interp(c.times, times, along) / speed for c, (times, _), along in clocks]
        steps = [np.diff(part, prepend=part[:1]) for part in reached]
    return [
        *_exposure(cameras), *_views(cameras), *_frozen(cameras, steps), _dropped(cameras)
    ]  # fmt: skip


def _dropped(cameras: Sequence[CameraMeasures]) -> Column:
    """Return the time without images, beyond the usual one between two of them.

    dropped = sum of d - p over times d between images above 1.5 p, p their median

    Equation: E20
    """
    steps = [np.diff(camera.times, prepend=camera.times[:1]) for camera in cameras]
    pauses = [
        np.where(step > PAUSE * period(camera.times), step - period(camera.times), 0)
        for step, camera in zip(steps, cameras, strict=True)
    ]
    rows = [max(int(part.argmax()) - 1, 0) for part in pauses]
    return column("dropped", [part.sum() for part in pauses], at=_times(cameras, rows))


def _frozen(cameras: Sequence[CameraMeasures], steps: Sequence[FloatArray] | None) -> list[Column]:
    """Return the motion behind a frozen image, and the share of repeated images.

    `steps` is the joint motion up to each image, in seconds of typical motion. Without it, motion
    is supposed to go on as before the image froze.

    frozen = largest motion within a run of images that equal the last or the one before
    repeated = share of images that change by less than 0.1 of the 0.75 quantile of the
        changes of 11 images around them

    Equation: E3
    Equation: E4
    """
    change = _all(cameras, "change")
    motion = change if steps is None else np.concatenate(steps)
    typical = float(np.median(change[motion >= np.median(motion)])) + 1e-9
    frozen, at, repeated = [], [], []
    for place, camera in enumerate(cameras):
        again, rows = camera.column("again"), np.arange(len(camera.times))
        same = again < SAME * typical
        wide = np.pad(camera.column("change"), AROUND, mode="edge")
        near = np.lib.stride_tricks.sliding_window_view(wide, 2 * AROUND + 1)
        if steps is None:
            last = np.maximum.accumulate(np.where(same, 0, rows))
            step = np.median(near[last][:, :AROUND], axis=1) / typical * period(camera.times)
        else:
            step = steps[place]
        hidden, first = longest(same[:, None], step[:, None])
        frozen.append(hidden[0])
        at.append(camera.times[first[0]])
        level = np.quantile(near, 0.75, axis=1)
        visible = level > SEEN * typical
        repeated.append((visible & (again < SAME * level)).sum() / (visible.sum() + 10))
    return [column("frozen", frozen, at=at), column("repeated", repeated)]


def _all(cameras: Sequence[CameraMeasures], name: str) -> FloatArray:
    return np.concatenate([camera.column(name) for camera in cameras])


def _exposure(cameras: Sequence[CameraMeasures]) -> list[Column]:
    """Return black images, brightness, and sharpness, of images less than 80 % black.

    black = largest share of pixels below 16
    light = largest |log(b + 1) - median|
    flicker = largest |log(b[t] + 1) - log(b[t-2] + 1)|
    blur = -(0.1 quantile of log(s + 1))

    Equation: E5
    Equation: E6
    Equation: E7
    Equation: E8
    """
    lit = [np.where(c.column("black") < DARK, 1.0, np.nan) for c in cameras]
    lit = [part if np.isfinite(part).any() else np.ones(len(part)) for part in lit]
    bright = [np.log(c.column("brightness") + 1) for c in cameras]
    level = np.nanmedian(np.concatenate([b * part for b, part in zip(bright, lit, strict=True)]))
    off = [np.nan_to_num((b - level) * part) for b, part in zip(bright, lit, strict=True)]
    sudden = [b - np.concatenate([b[:2], b[:-2]])[: len(b)] for b in bright]
    sharp = [np.log(c.column("sharpness") + 1) * part for c, part in zip(cameras, lit, strict=True)]
    blur = -np.array([np.nanquantile(part, 0.1) for part in sharp])
    columns = []
    for reason, parts in (("light", off), ("flicker", sudden)):
        rows = [int(np.abs(part).argmax()) for part in parts]
        most = np.array([part[row] for part, row in zip(parts, rows, strict=True)])
        columns.append(column(reason, np.abs(most), np.exp(most) - 1, _times(cameras, rows)))
    black = [c.column("black") for c in cameras]
    darkest = _times(cameras, [int(part.argmax()) for part in black])
    dullest = _times(cameras, [int(np.nanargmin(part)) for part in sharp])
    columns.append(column("black", [part.max() for part in black], at=darkest))
    return [*columns, column("blur", blur, np.exp(np.median(blur) - blur), dullest)]


def _times(cameras: Sequence[CameraMeasures], rows: Sequence[int]) -> FloatArray:
    return np.array([camera.times[row] for camera, row in zip(cameras, rows, strict=True)])


def _views(cameras: Sequence[CameraMeasures]) -> list[Column]:
    """Return how far the view is moved, and how its colors differ.

    camera = largest shift of the first and last third's median image, see `shift`
    colors = log mean over bins of ((log c - median) / deviation)^2
    tint = larger one of |log R / G - median| and |log B / G - median|

    Equation: E9
    Equation: E10
    Equation: E11
    """
    view = np.median([c.begin for c in cameras] + [c.end for c in cameras], axis=0)
    moved = np.array([max(shift(c.begin, view), shift(c.end, view)) for c in cameras])
    columns = [column("camera", moved, moved * cameras[0].scale)]
    if all(camera.colors.any() for camera in cameras):
        bins = np.log(np.stack([camera.colors for camera in cameras]) + 2e-4)
        apart = bins - np.median(bins, axis=0)
        spread = np.maximum(1.4826 * np.median(np.abs(apart), axis=0), 0.1)
        columns.append(column("colors", np.log(((apart / spread) ** 2).mean(1) + 1e-6)))
        mean = np.stack([c.thumbnails.reshape(-1, 3).mean(0) + 1 for c in cameras])
        ratios = np.log(mean[:, [0, 2]] / mean[:, 1:2])
        off = ratios - np.median(ratios, axis=0)
        worst = np.take_along_axis(off, np.abs(off).argmax(1)[:, None], axis=1)[:, 0]
        columns.append(column("tint", np.abs(worst), np.exp(worst) - 1))
    return columns


def shift(a: FloatArray, b: FloatArray) -> float:
    """Return by how many pixels image a is shifted against b: the peak of phase correlation.

    A shift counts if it makes a good part of the images more alike: a thing on the table that lies
    elsewhere is no shift.

    c = F^-1(A B* / (|A B*| + 0.05 mean |A B*|)), the largest c, A and B with Hann windows
    """
    if a.shape[0] < BLOCKS[0] or a.shape[1] < BLOCKS[1]:
        return 0.0
    window = np.hanning(a.shape[0])[:, None] * np.hanning(a.shape[1])
    one, two = (np.fft.rfft2((image - image.mean()) * window) for image in (a, b))
    product = one * two.conj()
    magnitude = np.abs(product)
    peaks = np.fft.irfft2(product / (magnitude + 0.05 * magnitude.mean() + 1e-9), a.shape)
    place = divmod(int(peaks.argmax()), a.shape[1])
    y, x = (p if p <= n // 2 else p - n for p, n in zip(place, a.shape, strict=True))
    moved = np.roll(a, (-y, -x), axis=(0, 1))
    plain, shifted = (block_means(np.abs(i - i.mean() - b + b.mean())) for i in (a, moved))
    texture = block_means(np.abs(b - b.mean()))
    weight = np.minimum(texture, np.median(texture))
    better = float((weight * (shifted < plain)).sum() / (weight.sum() + 1e-9))
    return float(np.hypot(y, x)) if better > EXPLAINED else 0.0


def block_means(image: FloatArray) -> FloatArray:
    """Return the means of `BLOCKS` of an image."""
    rows = np.array_split(image, BLOCKS[0])
    return np.array([[x.mean() for x in np.array_split(y, BLOCKS[1], axis=1)] for y in rows])
