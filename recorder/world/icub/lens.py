"""Effects of light, optics and sensor on an image, a function of seed, view and frame number.

The noise of a frame has its own random numbers, so that frames can be rendered in any order. It is
a sum of random bytes, which is the same on every machine.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, FloatArray
from recorder.world.icub.config import IcubConfig

# Rays along each side of a pixel; the pixel is their mean. More rays look smoother and take longer.
SAMPLES = 2

# Frames in which drifting light changes from its minimum to its maximum. Set by hand.
_RISE = 1500

# Stream number of the random noise.
_NOISE = 0x4015E

# Mean gray level to which automatic exposure adapts an image.
_EXPOSED = np.float32(128)

# Random bytes whose sum is one number of the noise, nearly Gaussian, and the factor that gives it
# a standard deviation of 1.
_BYTES = 4
_SPREAD = np.float32(1 / np.sqrt(_BYTES * (256**2 - 1) / 12))


def light(drift: float, t: int, n: int) -> FloatArray:
    """Return (n,) the factor of the light from frame t on, which drifts by a share."""
    phase = (t + np.arange(n)) % (2 * _RISE) / _RISE
    share = 1 - np.abs(phase - 1)
    return np.asarray(1 + drift * (2 * share * share * (3 - 2 * share) - 1))


class Lens:
    """Filter that makes frames from images with `SAMPLES` rays along each side of a pixel."""

    def __init__(self, scene: IcubConfig) -> None:
        self._scene, eyes = scene, scene.eyes
        y, x = ((np.arange(n) * 2 - (n - 1)) / eyes.width for n in (eyes.height, eyes.width))
        away = (y * y)[:, None] + x * x
        gain = (1 - scene.vignette * away / away.max()) / SAMPLES**2
        if scene.blur:
            gain /= 16
        self._gain = gain.astype(np.float32)[:, None, :, None]

    def through(self, rays: ByteArray, t: int, view: int) -> ByteArray:
        """Apply all effects to images of a view's eyes from frame t on.

        Args:
            rays: (n, SAMPLES height, eyes, SAMPLES width, channels) images.
            t: number of the first frame.
            view: index of the view.

        Returns:
            (n, height, eyes, width, channels) frames.
        """
        total: Any = rays[:, ::SAMPLES].astype(np.uint16)
        for i in range(1, SAMPLES):
            total += rays[:, i::SAMPLES]
        total = sum(total[:, :, :, i::SAMPLES] for i in range(SAMPLES))
        if self._scene.blur:
            total = _spread(_spread(total, 1), 3)
        image = total * self._gain
        if self._scene.drift:
            factors = light(self._scene.drift, t, len(image)).astype(np.float32)
            image *= factors[:, None, None, None, None]
        if self._scene.exposure:
            image *= _EXPOSED / np.maximum(_means(image), 1)[:, None, None, None, None]
        if self._scene.noise:
            # Half of the variance of the noise is constant, half grows with the light (shot noise).
            image += self._noise(t, view, image.shape) * np.sqrt(
                image * np.float32(1 / 256) + np.float32(0.5)
            )
        return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)

    def _noise(self, t: int, view: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return the noise of images from frame t on."""
        words = -(-int(np.prod(shape[1:])) * _BYTES // 32) * 4  # Philox makes four words at a time
        seed = np.array([self._scene.seed or 0, _NOISE + view], np.uint64)
        bits = np.random.Philox(key=seed)
        bits.advance(t * words // 4)
        raw = bits.random_raw(shape[0] * words).view(np.uint8).reshape(shape[0], _BYTES, -1)
        total = np.add.reduce(raw, axis=1, dtype=np.int16)[:, : int(np.prod(shape[1:]))]
        centred = total.reshape(shape) - np.float32(255 * _BYTES / 2)
        return np.asarray(centred * (_SPREAD * np.float32(self._scene.noise)))


def _means(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (n,) the means of images; sums of whole numbers do not depend on their order."""
    whole = np.rint(images).astype(np.int64).reshape(len(images), -1)
    return np.asarray(whole.sum(axis=1) / whole.shape[1], np.float32)


def _spread(image: Any, axis: int) -> Any:
    """Convolve with (1, 2, 1) along an axis; border pixels are repeated beyond the border."""
    image = image.swapaxes(0, axis)
    wide = 2 * image
    wide[1:] += image[:-1]
    wide[:-1] += image[1:]
    wide[0] += image[0]
    wide[-1] += image[-1]
    return wide.swapaxes(0, axis)
