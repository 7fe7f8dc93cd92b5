"""The IncSFA kernels: against the equations, batch SFA and each other."""

import numpy as np
import pytest

from cdmisfa.core.arithmetic.choice import portable_bits
from cdmisfa.core.blocks import PIXEL, freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.expansion import quadratic
from cdmisfa.features.incsfa import gram, strict
from cdmisfa.features.incsfa.abstraction import IncSFA
from cdmisfa.features.incsfa.cells import changing_cells
from cdmisfa.features.incsfa.state import State, new_state, parameters, rank_floor
from cdmisfa.features.projection import mean_output, project
from cdmisfa.features.sfa import batch_sfa, slowness
from recorder.world.oscillatory import OscillatorySource, one_period


class PlainIncSFA:
    """The rule written once more, frame by frame in numpy, in any float type."""

    def __init__(self, state: State, config: LearnerConfig, dtype=np.float64):
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
            v[:] = (1 - weight) * v + weight * (r @ v) / np.sqrt(v @ v) * r
            r -= (r @ v) / (v @ v) * v
        scale = np.sqrt((self.v**2).sum(axis=1)) ** self.dtype(-1.5)
        z = (self.v @ u) * scale
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


def config_of(components: int, outputs: int, **more) -> LearnerConfig:
    return LearnerConfig(components=components, outputs=outputs, nu=0.02, **more)


def latent_frames(n: int, size: int, seed: int = 0) -> np.ndarray:
    """Frames of a few latents of different speed, with noise, around one half."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)[:, None]
    latents = np.sin(t * np.linspace(0.02, 1.3, 10) + np.arange(10)) * np.linspace(1.0, 0.3, 10)
    mixing = rng.standard_normal((10, size)) / 10
    return freeze(0.5 + latents @ mixing + 0.02 * rng.standard_normal((n, size)))


def mostly_still_frames(n: int, size: int, cuts) -> np.ndarray:
    """Frames of which three columns in ten change within a block, elsewhere in each."""
    frames, start = latent_frames(n, size).copy(), 0
    for number, length in enumerate(cuts):
        moving = np.roll(np.arange(size) < 0.3 * size, 37 * number)
        frames[start : start + length, ~moving] = frames[start, ~moving]
        start += length
    return freeze(frames)


def learn_in(kernel, config, frames, cuts, gaps=(), seed=3):
    """State and xi after learning from blocks of the lengths `cuts`; `gaps` are block numbers."""
    state = new_state(np.random.default_rng(seed), frames.shape[1], config)
    xi = np.full(len(frames), -1.0)
    start = 0
    for number, length in enumerate(cuts):
        part = slice(start, start + length)
        kernel.update(state, parameters(config), frames[part], number in gaps, xi[part])
        start += length
    assert start == len(frames)
    return state, xi


def assert_states_close(a: State, b: State, rtol: float) -> None:
    for name in ("mean", "v", "d", "w", "z_prev", "phi"):
        x, y = getattr(a, name), getattr(b, name)
        np.testing.assert_allclose(x, y, rtol=0, atol=rtol * np.abs(x).max(), err_msg=name)
    np.testing.assert_array_equal(a.counts[:2], b.counts[:2])


@pytest.mark.parametrize("stream", [0, 1, 2])
def test_each_oscillatory_stream_alone_gives_the_slow_feature_of_batch_sfa(stream):
    config = LearnerConfig()
    sfa = IncSFA(config, 5, np.random.default_rng(stream))
    source = OscillatorySource()
    for _ in range(300):
        sfa.update(quadratic(source.take(stream, 100).frames))
    x = quadratic(one_period(f"x{stream + 1}"))
    y = project(sfa.phi, sfa.phi @ sfa.mean, np.tile(x, (4, 1)))
    assert slowness(y)[0] == pytest.approx([0.008, 0.006, 0.004][stream], rel=0.01)
    assert y.var() == pytest.approx(1.0, abs=0.1)
    found, true = sfa.phi[0], batch_sfa(np.tile(x, (2, 1)), 1)[0]
    assert abs(found @ true) / np.sqrt((found @ found) * (true @ true)) > 0.99


@pytest.mark.parametrize("kernel", [strict, gram])
@pytest.mark.parametrize(("size", "components", "outputs"), [(5, 5, 3), (300, 7, 1), (513, 6, 5)])
def test_kernels_follow_the_equations(kernel, size, components, outputs):
    config = config_of(components, outputs, mean_window=50)
    frames = latent_frames(300, size)
    cuts, gaps = [1, 1, 2, 3, 43, 50, 1, 1, 98, 100], (3, 5, 6, 9)
    state, xi = learn_in(kernel, config, frames, cuts, gaps)
    start = new_state(np.random.default_rng(3), size, config)
    plain = PlainIncSFA(start, config, np.longdouble)
    starts = np.cumsum([0, *cuts])
    expected = [plain.learn(x, t in starts[list(gaps)]) for t, x in enumerate(frames)]
    np.testing.assert_allclose(xi, expected, rtol=1e-8)
    for name in ("mean", "v", "w", "z_prev", "phi"):
        x, y = getattr(state, name), getattr(plain, name).astype(float)
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-9 * np.abs(y).max(), err_msg=name)


@pytest.mark.parametrize("length", [1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 41])
@pytest.mark.parametrize("gap", [False, True])
@pytest.mark.parametrize("still", [False, True])
def test_gram_kernel_follows_the_strict_one_whatever_the_blocks_length(length, gap, still):
    config = config_of(6, 2)
    cuts, gaps = [length] * 5, (2, 3) if gap else ()
    frames = mostly_still_frames(5 * length, 260, cuts) if still else latent_frames(5 * length, 260)
    a, xi_a = learn_in(strict, config, frames, cuts, gaps)
    b, xi_b = learn_in(gram, config, frames, cuts, gaps)
    np.testing.assert_allclose(xi_b, xi_a, rtol=1e-9)
    assert np.isnan(xi_a).sum() == 1 + len(gaps)
    assert_states_close(a, b, 1e-10)
    np.testing.assert_allclose(b.gram, b.v @ b.v.T, rtol=0, atol=1e-12 * b.gram.max())


@pytest.mark.parametrize(("size", "components"), [(320, 7), (517, 8), (264, 3)])
@pytest.mark.parametrize("pixels", [False, True])
def test_columns_that_stand_still_within_a_block_are_learned_like_the_others(
    size, components, pixels
):
    config = config_of(components, 2, mean_window=50)
    cuts, gaps = [40, 1, 1, 2, 3, 33, 1, 40, 5, 40], (1, 4, 6, 7)
    frames = mostly_still_frames(sum(cuts), size, cuts)
    if pixels:
        frames = freeze(np.round(frames * 255).clip(0, 255).astype(np.uint8))
    assert len(changing_cells(frames[:40], components)) < 0.5 * (size // 8)
    state, xi = learn_in(gram, config, frames, cuts, gaps)
    start = new_state(np.random.default_rng(3), size, config)
    plain, starts = PlainIncSFA(start, config, np.longdouble), np.cumsum([0, *cuts])
    values = frames / np.longdouble(255) if pixels else frames
    expected = [plain.learn(x, t in starts[list(gaps)]) for t, x in enumerate(values)]
    np.testing.assert_allclose(xi, np.array(expected, float), rtol=1e-8)
    for name in ("mean", "v", "w", "z_prev", "phi"):
        x, y = getattr(state, name), getattr(plain, name).astype(float)
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-9 * np.abs(y).max(), err_msg=name)
    np.testing.assert_allclose(state.gram, state.v @ state.v.T, rtol=0, atol=1e-12)


def test_cells_that_change_are_found_or_all_taken_where_most_do():
    frames = np.zeros((40, 83), np.uint8)
    frames[7, 17] = frames[39, 64] = frames[3, 82] = 1  # the last is in no whole cell
    assert changing_cells(frames, 8).tolist() == [2, 8]
    assert changing_cells(frames[:8], 8).tolist() == [2]
    assert changing_cells(frames[:1], 4).tolist() == []
    assert changing_cells(frames[:1], 5).tolist() == list(range(10))  # too few frames to pay off
    frames[20, 24:56:8] = 1
    assert changing_cells(frames, 8).tolist() == [2, 3, 4, 5, 6, 8]
    frames[20, 72] = 1
    assert changing_cells(frames, 8).tolist() == list(range(10))


@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize("pixels", [False, True])
def test_gram_kernel_is_as_near_to_long_double_as_two_direct_orders_are(pixels, still):
    """The two: sums over the inputs from the first to the last, and from the last to the first."""
    config, n, size = config_of(8, 2), 2400, 400
    frames = mostly_still_frames(n, size, [40] * (n // 40)) if still else latent_frames(n, size)
    if pixels:
        frames = freeze(np.round(frames * 255) / 255)
    start = new_state(np.random.default_rng(3), size, config)
    backwards = new_state(np.random.default_rng(3), size, config)
    backwards.v[:] = start.v[:, ::-1]
    xi_backwards = np.empty(n)
    reverse = freeze(np.ascontiguousarray(frames[:, ::-1]))
    strict.update(backwards, parameters(config), reverse, False, xi_backwards)
    direct, xi_direct = learn_in(strict, config, frames, [n])
    block, xi_block = learn_in(gram, config, frames, [40] * (n // 40))
    plain = PlainIncSFA(start, config, np.longdouble)
    xi = np.array([plain.learn(x) for x in frames])

    def errors(v, phi, own_xi):
        change = np.nanmedian(np.abs(own_xi - xi) / xi)
        return np.array([np.abs(v - plain.v).max(), np.abs(phi - plain.phi).max(), change])

    first = errors(direct.v, direct.phi, xi_direct)
    second = errors(backwards.v[:, ::-1], backwards.phi[:, ::-1], xi_backwards)
    assert (errors(block.v, block.phi, xi_block) <= np.maximum(first, second)).all()


def test_error_of_the_carried_gram_matrix_does_not_grow():
    config = config_of(7, 1)
    frames = latent_frames(4000, 256)
    state, _ = learn_in(gram, config, frames, [40] * 100)
    lengths = state.d[:, None] * state.d
    assert np.abs((state.gram - state.v @ state.v.T) / lengths).max() < 1e-12


@pytest.mark.parametrize("kernel", [strict, gram])
def test_pixels_are_learned_like_their_255ths(kernel):
    config = config_of(5, 1)
    pixels = freeze(np.round(latent_frames(120, 320) * 255).clip(0, 255).astype(np.uint8))
    a, xi_a = learn_in(kernel, config, pixels, [40] * 3)
    b, xi_b = learn_in(kernel, config, freeze(pixels * PIXEL), [40] * 3)
    np.testing.assert_allclose(xi_a, xi_b, rtol=1e-9)
    assert_states_close(a, b, 1e-11)
    y = project(a.phi, a.phi @ a.mean, pixels)
    np.testing.assert_allclose(y, (pixels / 255.0 - a.mean) @ a.phi.T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kernel", [strict, gram])
@pytest.mark.parametrize("rank", [0, 1, 2])
def test_directions_without_variance_give_no_output(kernel, rank):
    """60,000 frames later the vectors that nothing feeds have shrunk to the floor, and rest."""
    config = config_of(5, 1)
    rng = np.random.default_rng(0)
    t = np.arange(500)[:, None]
    latents = np.sin(t * 2 * np.pi * np.array([1, 7])[:rank] / 500)
    frames = freeze(0.5 + latents @ rng.standard_normal((rank, 220)))
    state = new_state(rng, 220, config)
    state.counts[0] = 10_000_000
    state.mean[:] = frames.mean(axis=0)
    if rank == 0:
        state.v[:] *= 1e-25
        state.d[:] *= 1e-25
    xi = np.empty(500)
    for _ in range(120):
        kernel.update(state, parameters(config), frames, False, xi)
    assert all(np.isfinite(a).all() for a in state)
    floor = rank_floor(state.d)
    at_rest = state.d <= floor
    assert at_rest.sum() == (5 if rank == 0 else 4 if rank == 1 else 2)
    assert (state.d[at_rest] > 0.9 * floor).all()
    assert (state.z_prev[at_rest] == 0).all()
    if rank == 1:
        y = project(state.phi, state.phi @ state.mean, frames)
        assert slowness(y)[0] == pytest.approx(1 / 500, rel=0.05)
        assert y.var() == pytest.approx(1.0, abs=0.1)


def test_a_component_at_rest_wakes_when_the_input_varies_along_it():
    config = config_of(2, 1)
    state = new_state(np.random.default_rng(0), 3, config)
    state.counts[0] = 1000
    state.v[:] = [[1.0, 0.0, 0.0], [0.0, 1e-14, 0.0]]
    state.d[:] = [1.0, 1e-14]
    frames = freeze(np.random.default_rng(1).standard_normal((400, 3)) * [1.0, 0.5, 0.0])
    strict.update(state, parameters(config), frames, True, np.empty(400))
    assert state.d[1] > 1e-3
    assert np.abs(state.z_prev[1]) > 0


@pytest.mark.parametrize("size", [5, 300])
def test_same_blocks_give_the_same_bits_and_inputs_stay(size):
    config = config_of(4, 2)
    frames = latent_frames(200, size)
    results = []
    for _ in range(2):
        sfa = IncSFA(config, size, np.random.default_rng(0))
        xi = np.concatenate([sfa.update(frames[k : k + 40], k == 80) for k in range(0, 200, 40)])
        results.append((xi.tobytes(), *(a.tobytes() for a in sfa.state)))
    assert results[0] == results[1]


@pytest.mark.parametrize("kernel", [strict, gram])
def test_a_saved_state_goes_on_with_the_same_bits(kernel):
    config = config_of(4, 1)
    frames = latent_frames(2400, 210)
    a, xi = learn_in(kernel, config, frames, [40] * 60)
    half, _ = learn_in(kernel, config, frames[:1200], [40] * 30)
    copy = new_state(np.random.default_rng(9), 210, config)
    for source, target in zip(half, copy, strict=True):
        target[...] = source
    rest = np.empty(1200)
    for k in range(0, 1200, 40):
        block = frames[1200 + k : 1240 + k]
        kernel.update(copy, parameters(config), block, False, rest[k : k + 40])
    assert rest.tobytes() == xi[1200:].tobytes()
    assert all(x.tobytes() == y.tobytes() for x, y in zip(a, copy, strict=True))


def test_strict_bits_do_not_depend_on_how_frames_are_cut():
    config = config_of(5, 1)
    frames = latent_frames(300, 5)
    a, xi_a = learn_in(strict, config, frames, [300])
    b, xi_b = learn_in(strict, config, frames, [1, 99, 7, 193])
    assert xi_a.tobytes() == xi_b.tobytes()
    assert a.phi.tobytes() == b.phi.tobytes()


@pytest.mark.parametrize("pixels", [False, True])
@pytest.mark.parametrize("portable", [False, True])
@pytest.mark.parametrize(("rows", "size", "n"), [(4, 1300, 9), (7, 1024, 67), (3, 544, 5)])
def test_outputs_of_a_row_do_not_depend_on_the_rows_beside_it(rows, size, n, portable, pixels):
    """Nor do those of a frame on its block: neither tells where it is paired, or alone."""
    rng = np.random.default_rng(0)
    phi, offset = rng.standard_normal((rows, size)), rng.standard_normal(rows)
    frames = rng.integers(0, 256, (n, size), np.uint8) if pixels else rng.normal(size=(n, size))
    with portable_bits(portable):
        stacked = project(phi, offset, frames)
        values = frames * PIXEL if pixels else frames
        np.testing.assert_allclose(stacked, values @ phi.T - offset, rtol=1e-10, atol=1e-10)
        for row in range(rows):
            for first, stop in ((0, n), (1, 2), (2, 5)):
                some = phi[row : row + 2], offset[row : row + 2], frames[first:stop]
                alone = project(some[0][:1], some[1][:1], some[2])
                assert alone[:, 0].tobytes() == stacked[first:stop, row].tobytes()
                assert project(*some).tobytes() == stacked[first:stop, row : row + 2].tobytes()
        assert project(phi[:0], offset[:0], frames).shape == (n, 0)
        assert project(phi, offset, frames[:0]).shape == (0, rows)


def test_pixels_are_projected_as_their_values_are():
    rng = np.random.default_rng(1)
    phi, offset = rng.standard_normal((5, 700)), rng.standard_normal(5)
    pixels = rng.integers(0, 256, (70, 700), dtype=np.uint8)
    values = pixels * PIXEL
    assert project(phi, offset, pixels).tobytes() == project(phi, offset, values).tobytes()


@pytest.mark.parametrize("outputs", [1, 4, 6])
def test_the_mean_output_is_summed_in_order(outputs):
    rng = np.random.default_rng(2)
    phi, mean = rng.standard_normal((outputs, 300)), rng.standard_normal(300)
    plain = np.zeros(outputs)
    for i in range(300):
        plain += phi[:, i] * mean[i]
    assert mean_output(phi, mean).tobytes() == plain.tobytes()
