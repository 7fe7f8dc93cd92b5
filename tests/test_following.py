"""A module's output, and the quantity of the world that it follows."""

from __future__ import annotations

import numpy as np
import pytest

from replay.following import OutputHistory


def output_of(y, *truth):
    return OutputHistory(1, 0, np.arange(len(y)), y, np.column_stack(truth))


def test_an_output_finds_the_truth_it_follows():
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((500, 3))
    y = -2 * truth[:, 1] + 0.01 * rng.standard_normal(500)
    found = output_of(y, truth, np.ones(500)).best_fit(("a", "b", "c", "constant"))
    assert (found.column, found.function) == (1, "b")
    assert found.r > 0.99
    np.testing.assert_allclose(found(truth[:, 1]), -2 * truth[:, 1], atol=0.01)
    assert output_of(y, np.ones(500)).best_fit(("constant",)) is None


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda x: 2 - x, "angle"),
        (lambda x: (x - 3) ** 2, "a parabola of angle"),
        (lambda x: np.sin(x - 1), "sin(angle + c)"),
        (lambda x: 3 * np.sin(4 * x - np.pi / 4) + 1, "sin(4 angle + c)"),
    ],
)
def test_the_simplest_function_of_a_truth_is_named(function, said):
    """The oscillatory streams' slow features are sines of a phase, which itself they follow not."""
    phase = 2 * np.pi * np.arange(1000) / 500 % (2 * np.pi)
    noise = 0.05 * np.random.default_rng(0).standard_normal(1000)
    found = output_of(function(phase) + noise, phase).best_fit(("angle",))
    assert found.function == said
    assert found.r > 0.99
    np.testing.assert_allclose(found(phase), function(phase), atol=0.05)


def test_no_phase_is_seen_in_what_does_not_go_round():
    x = np.linspace(0.4, 0.6, 500)
    found = output_of(np.sin(200 * x), x).best_fit(("box_y",))
    assert found.function in ("box_y", "a parabola of box_y")
    places = np.array([0.4, 0.6, 0.4, 0.6])
    found = output_of(np.array([1.0, 3.0, 1.0, 3.0]), places).best_fit(("box_y",))
    assert found.function == "box_y"
    np.testing.assert_allclose(found(np.array([0.4, 0.6])), [1.0, 3.0])
