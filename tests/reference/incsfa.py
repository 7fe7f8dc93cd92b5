"""IncSFA by its equations."""

import numpy as np

from cdmisfa.core.config import LearnerConfig
from cdmisfa.features.incsfa import IncSFAState


class PlainIncSFA:
    """The rule frame by frame, in any float type and with any way to sum over the inputs."""

    def __init__(self, state: IncSFAState, config: LearnerConfig, dtype=np.float64, dot=np.dot):
        self.dot = dot
        self.config, self.n, self.dtype = config, 0, dtype
        self.mean, self.v, self.w = (x.astype(dtype) for x in (state.mean, state.v, state.w))
        self.phi = state.phi.astype(dtype)
        self.z_prev = None

    def learn(self, x, gap=False):
        nu, one = self.dtype(self.config.nu), self.dtype(1)
        x = x.astype(self.dtype)
        self.n += 1
        self.mean = self.mean + max(2 * one / (self.config.mean_window + 1), one / self.n) * (
            x - self.mean
        )
        u = x if self.n == 1 else x - self.mean
        k = self.dtype(self.n + 1)
        amnesia = 0 if k < 20 else 3 * (k - 20) / 180 if k < 200 else 3 + (k - 200) / 2000
        weight = (1 + amnesia) / k
        r = u.copy()
        for v in self.v:
            v[:] = (1 - weight) * v + weight * self.dot(v, r) / np.sqrt(self.dot(v, v)) * r
            r -= self.dot(v, r) / self.dot(v, v) * v
        scale = np.sqrt((self.v**2).sum(axis=1)) ** self.dtype(-1.5)
        z = self.dot(self.v, u) * scale
        before, self.z_prev = self.z_prev, z
        if gap or before is None:
            return np.nan
        z_dot = z - before
        for j, w in enumerate(self.w):
            step = z_dot * (z_dot @ w)
            for p in self.w[:j]:
                step += (24 * one / 100) / nu * p * (p @ w)
            rate = nu / (1 + 12 * one / 10 * j)
            w[:] = (3 * one / 2 - rate) * w - rate * step
            w /= np.sqrt(w @ w)
        old, self.phi = self.phi, (self.w * scale) @ self.v
        return float(np.sqrt(((self.phi - old) ** 2).sum()))
