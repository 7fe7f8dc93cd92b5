"""The IncSFA kernels: against the equations, batch SFA and each other."""

import numpy as np
import pytest
from both_modules import assert_same_bits, both_modules
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.incsfa import PlainIncSFA

from cdmisfa import kernels
from cdmisfa.core.blocks import PIXEL, freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import quadratic
from cdmisfa.features.incsfa import IncrementalFeature, IncSFAState, new_state
from cdmisfa.features.outputs import project
from cdmisfa.features.sfa import batch_sfa, slowness
from recorder.world.oscillatory import OscillatorySource, one_period

STRICT, GRAM = "by_frame", "by_gram"


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
    abstraction = kernels.incsfa(state, config.nu, config.mean_window)
    starts = np.cumsum([0, *cuts])
    assert starts[-1] == len(frames)
    xi = [
        kernels.incsfa_update(abstraction, frames[start : start + length], number in gaps, kernel)
        for number, (start, length) in enumerate(zip(starts, cuts, strict=False))
    ]
    return state, np.concatenate(xi)


def learn(kernel, config, state, frames, gap=False):
    abstraction = kernels.incsfa(state, config.nu, config.mean_window)
    return kernels.incsfa_update(abstraction, frames, gap, kernel)


def assert_states_close(a: IncSFAState, b: IncSFAState, rtol: float) -> None:
    for name in ("mean", "v", "d", "w", "z_prev", "phi"):
        x, y = getattr(a, name), getattr(b, name)
        np.testing.assert_allclose(x, y, rtol=0, atol=rtol * np.abs(x).max(), err_msg=name)
    np.testing.assert_array_equal(a.counts[:2], b.counts[:2])


@pytest.mark.parametrize("stream", [0, 1, 2])
def test_each_oscillatory_stream_alone_gives_the_slow_feature_of_batch_sfa(stream):
    config = LearnerConfig()
    sfa = IncrementalFeature(config, 5, np.random.default_rng(stream))
    source = OscillatorySource()
    for _ in range(300):
        sfa.update(quadratic(source.take(stream, 100).frames))
    x = quadratic(one_period(f"x{stream + 1}"))
    y = project(sfa.phi, sfa.phi @ sfa.mean, np.tile(x, (4, 1)))
    assert slowness(y)[0] == pytest.approx([0.008, 0.006, 0.004][stream], rel=0.01)
    assert y.var() == pytest.approx(1.0, abs=0.1)
    result, true = sfa.phi[0], batch_sfa(np.tile(x, (2, 1)), 1)[0]
    assert abs(result @ true) / np.sqrt((result @ result) * (true @ true)) > 0.99


@pytest.mark.parametrize("kernel", [STRICT, GRAM])
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
    a, xi_a = learn_in(STRICT, config, frames, cuts, gaps)
    b, xi_b = learn_in(GRAM, config, frames, cuts, gaps)
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
    state, xi = learn_in(GRAM, config, frames, cuts, gaps)
    start = new_state(np.random.default_rng(3), size, config)
    plain, starts = PlainIncSFA(start, config, np.longdouble), np.cumsum([0, *cuts])
    values = frames / np.longdouble(255) if pixels else frames
    expected = [plain.learn(x, t in starts[list(gaps)]) for t, x in enumerate(values)]
    np.testing.assert_allclose(xi, np.array(expected, float), rtol=1e-8)
    for name in ("mean", "v", "w", "z_prev", "phi"):
        x, y = getattr(state, name), getattr(plain, name).astype(float)
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-9 * np.abs(y).max(), err_msg=name)
    np.testing.assert_allclose(state.gram, state.v @ state.v.T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kernel", [STRICT, GRAM])
def test_pixels_are_learned_like_their_255ths(kernel):
    config = config_of(5, 1)
    pixels = freeze(np.round(latent_frames(120, 320) * 255).clip(0, 255).astype(np.uint8))
    a, xi_a = learn_in(kernel, config, pixels, [40] * 3)
    b, xi_b = learn_in(kernel, config, freeze(pixels * PIXEL), [40] * 3)
    np.testing.assert_allclose(xi_a, xi_b, rtol=1e-9)
    assert_states_close(a, b, 1e-11)
    y = project(a.phi, a.phi @ a.mean, pixels)
    np.testing.assert_allclose(y, (pixels / 255.0 - a.mean) @ a.phi.T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kernel", [STRICT, GRAM])
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
    for _ in range(120):
        learn(kernel, config, state, frames)
    assert all(np.isfinite(a).all() for a in state)
    floor = max(1e-10 * state.d.max(), 1e-30)
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
    learn(STRICT, config, state, frames, gap=True)
    assert state.d[1] > 1e-3
    assert np.abs(state.z_prev[1]) > 0


@pytest.mark.parametrize("pixels", [False, True])
@pytest.mark.parametrize(("rows", "size", "n"), [(4, 1300, 9), (7, 1024, 67), (3, 544, 5)])
def test_outputs_of_a_row_do_not_depend_on_the_rows_beside_it(rows, size, n, pixels):
    """Nor do those of a frame on its block: neither tells where it is paired, or alone."""
    rng = np.random.default_rng(0)
    phi, offset = rng.standard_normal((rows, size)), rng.standard_normal(rows)
    frames = rng.integers(0, 256, (n, size), np.uint8) if pixels else rng.normal(size=(n, size))
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


odd = st.sampled_from([0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 5e-324, 1e-310, 1e308])


@settings(max_examples=150, deadline=None)
@given(
    size=st.integers(1, 70),
    K=st.integers(1, 9),
    n=st.integers(1, 11),
    kernel=st.sampled_from([STRICT, GRAM]),
    gap=st.booleans(),
    seed=st.integers(0, 99),
    values=st.lists(st.tuples(st.integers(0, 10**6), odd), max_size=4),
)
def test_any_numbers_are_learned_within_the_arrays_alike_by_both_modules(
    size, K, n, kernel, gap, seed, values
):
    """Of NaN and infinities come numbers that are none, the same on every processor."""
    rng = np.random.default_rng(seed)
    frames = rng.standard_normal((n, size))
    for place, value in values:
        frames.flat[place % frames.size] = value
    config = config_of(K, min(K, 1 + seed % 3))
    result = []
    for module in both_modules():
        with module:
            a, xi = learn_in(kernel, config, freeze(frames), [n], (0,) if gap else ())
            result.append([xi, *a])
    assert_same_bits(*result)


@pytest.mark.parametrize("what", [0, 2])
def test_a_state_that_no_kernel_left_is_refused(what):
    sfa = IncrementalFeature(config_of(4, 1), 300, np.random.default_rng(0))
    sfa.state.counts[what] = -1
    with pytest.raises(UsageError, match="damaged state"):
        sfa.update(np.zeros((3, 300)))


def test_arrays_of_another_shape_or_order_are_refused():
    state = new_state(np.random.default_rng(0), 6, config_of(4, 1))
    for wrong in (state.w[:, ::-1], state.w[:, :3], state.w.astype(np.float32), [[1.0] * 4]):
        with pytest.raises(UsageError, match=r"^w "):
            kernels.incsfa(state._replace(w=wrong), 0.1, 10)


def test_error_of_the_carried_gram_matrix_does_not_grow():
    config = config_of(7, 1)
    frames = latent_frames(4000, 256)
    state, _ = learn_in(GRAM, config, frames, [40] * 100)
    lengths = state.d[:, None] * state.d
    assert np.abs((state.gram - state.v @ state.v.T) / lengths).max() < 1e-12


def test_strict_bits_do_not_depend_on_how_frames_are_cut():
    config = config_of(5, 1)
    frames = latent_frames(300, 5)
    a, xi_a = learn_in(STRICT, config, frames, [300])
    b, xi_b = learn_in(STRICT, config, frames, [1, 99, 7, 193])
    assert xi_a.tobytes() == xi_b.tobytes()
    assert a.phi.tobytes() == b.phi.tobytes()
