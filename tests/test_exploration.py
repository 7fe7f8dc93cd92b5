"""Epsilon, the choice of an action, and where a switch leads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.agent import choose, decay, other_stream

unit = st.floats(0, 1, exclude_max=True)


def test_epsilon_decays_slowly_to_the_knee_and_fast_below() -> None:
    epsilon, slow = 1.2, 0
    while epsilon > 0.8:
        epsilon = decay(epsilon, 0.999, 0.8, 0.95)
        slow += 1
    assert slow == np.ceil(np.log(0.8 / 1.2) / np.log(0.999))
    assert decay(epsilon, 0.999, 0.8, 0.95) == epsilon * 0.95
    assert decay(0.8, 0.999, 0.8, 0.95) == 0.8 * 0.95


@given(st.floats(1, 1.2), unit, unit, st.integers(0, 1))
def test_epsilon_of_one_and_more_is_certainty(
    epsilon: float, coin: float, draw: float, greedy: int
) -> None:
    action, explored = choose(epsilon, greedy, coin, draw)
    assert explored
    assert action == (draw >= 0.5)


@given(unit, unit, st.integers(0, 1))
def test_epsilon_zero_is_greedy(coin: float, draw: float, greedy: int) -> None:
    assert choose(0.0, greedy, coin, draw) == (greedy, False)


def test_the_coin_is_compared_with_epsilon() -> None:
    assert choose(0.3, 0, 0.29, 0.9) == (1, True)
    assert choose(0.3, 0, 0.3, 0.9) == (0, False)


@given(st.integers(2, 10_000), st.data())
def test_a_switch_never_stays(n: int, data: st.DataObject) -> None:
    stream = data.draw(st.integers(0, n - 1))
    following = other_stream(stream, n, data.draw(unit))
    assert 0 <= following < n
    assert following != stream


@pytest.mark.parametrize("n", [2, 3, 7])
def test_a_switch_is_uniform_over_the_others(n: int) -> None:
    draws = (np.arange(6 * (n - 1) * 100) + 0.5) / (6 * (n - 1) * 100)
    for stream in range(n):
        hits = np.bincount([other_stream(stream, n, d) for d in draws], minlength=n)
        assert hits[stream] == 0
        assert set(np.delete(hits, stream)) == {600}


def test_the_largest_draw_stays_in_range() -> None:
    assert other_stream(2, 3, np.nextafter(1.0, 0.0)) == 1


def test_a_single_stream_has_no_other() -> None:
    assert other_stream(0, 1, 0.7) == 0
