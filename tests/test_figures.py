"""The figures of a run are drawn, show what they should, and are the same every time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from PIL import Image
from run_data import IMAGE, PROGRESS, VECTOR, by_progress, write_run

from cdmisfa.core.errors import UsageError
from replay.export import figures
from replay.export.figures import decision, draw_figures, modules, streams
from replay.export.history import OutputHistory, read_history


@pytest.mark.parametrize(("spec", "count"), [(IMAGE, 4), (VECTOR, 3)], ids=["images", "vectors"])
def test_each_figure_is_a_picture_twice(spec, count, tmp_path):
    write_run(tmp_path / "run.mcap", spec, 30, saves=True)
    files = draw_figures(tmp_path)
    assert [f.parent.name for f in files] == ["figures"] * 2 * count
    for file in files:
        if file.suffix == ".png":
            with Image.open(file) as picture:
                assert min(picture.size) > 200
                assert len(np.unique(np.asarray(picture.convert("L")))) > 20
        else:
            assert file.read_text("utf-8").rstrip().endswith("</svg>")
    assert {f.name for f in files} == {p.name for p in (tmp_path / "figures").iterdir()}


def test_figures_are_the_same_bytes_every_time_and_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "FIGURES", {"convergence": figures.convergence})
    write_run(tmp_path / "run.mcap", VECTOR, 12, saves=True)
    first = draw_figures(tmp_path, tmp_path / "a")
    second = draw_figures(tmp_path, tmp_path / "b")
    assert [f.read_bytes() for f in first] == [f.read_bytes() for f in second]
    with pytest.raises(UsageError, match="--force"):
        draw_figures(tmp_path, tmp_path / "a")
    draw_figures(tmp_path, tmp_path / "a", force=True)


def drawn(run):
    """The figures that a run has."""
    history = read_history(run)
    return {name for name, draw in figures.FIGURES.items() if draw(history) is not None}


def test_a_run_without_iterations_or_modules_is_drawn(tmp_path):
    for count in (0, 1):
        folder = tmp_path / str(count)
        folder.mkdir()
        write_run(folder / "run.mcap", VECTOR, count)
        assert drawn(folder) == ({"convergence", "decision"} if count else set())


def test_the_history_is_that_of_the_log(tmp_path):
    records = write_run(tmp_path / "run.mcap", IMAGE, 30, saves=True)
    history = read_history(tmp_path / "run.mcap")
    assert history.outline.iterations == 30
    np.testing.assert_array_equal(history.stream, [s.stream for s in records])
    np.testing.assert_array_equal(history.eta_dot, [s.eta_dot for s in records])
    np.testing.assert_array_equal(history.stay_reward[:, 2], [s.R[2, 0, 2] for s in records])
    first = history.outputs[0]
    assert first.module == 1
    later = [s for s in records if len(s.y_frozen) and s.stream == first.stream]
    np.testing.assert_array_equal(
        first.y[-40 * len(later) :], np.concatenate([s.y_frozen[0, :, 0] for s in later])
    )
    for strip in history.pictures:
        for t, image, _ in strip.frames:
            assert image.min() == 40 * strip.stream + 20
            assert records[t // 40].stream == strip.stream


def test_policy_is_drawn_where_it_stays(tmp_path):
    records = write_run(tmp_path / "run.mcap", VECTOR, 30)
    figure = decision(read_history(tmp_path / "run.mcap"))
    assert figure is not None
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels[1:] == ["R for staying", "policy: stay", "random ε"]
    assert len(records) == 30


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


def test_the_progress_learner_has_one_figure_of_its_streams(tmp_path):
    records = write_run(
        tmp_path / "run.mcap", VECTOR, 30, saves=True, learner=PROGRESS, edit=by_progress
    )
    assert drawn(tmp_path) == {"streams", "modules"}
    history = read_history(tmp_path)
    figure = streams(history)
    lanes, error, slowness, watched = figure.axes
    (became,) = lanes.child_axes
    labels = [text.get_text() for text in became.get_yticklabels()]
    assert labels == ["learned by 1", "known by 2", "learning"]
    assert len(lanes.patches) == 2 + 2 + 3
    alone = 0
    for s, (line, dots) in enumerate(zip(error.lines[:6:2], error.lines[1:6:2], strict=True)):
        expected = np.array(
            [
                r.learning_error if r.stream == s and np.isfinite(r.tested) else np.nan
                for r in records
            ]
        )  # so no line crosses what was not watched
        np.testing.assert_array_equal(line.get_ydata(), expected)
        assert np.isin(dots.get_ydata(), expected).all()
        alone += len(dots.get_ydata())
    assert alone > 0
    for axes in (error, slowness, watched):
        assert any(np.isfinite(line.get_ydata()).any() for line in axes.lines)
    np.testing.assert_allclose(sum(line.get_ydata() for line in watched.lines[:3]), 1)


def test_outputs_are_on_one_scale_and_panels_have_letters(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 30, saves=True)
    figure = modules(read_history(tmp_path))
    assert len({axes.get_ylim() for axes in figure.axes}) == 1
    letters = [axes.get_title("left") for axes in figure.axes if axes.axison]
    assert letters == [f"({letter})" for letter in "abcdef"[: len(letters)]]


def test_what_the_world_does_not_tell_takes_no_room(tmp_path):
    spec = dataclasses.replace(VECTOR, truth=())
    write_run(tmp_path / "run.mcap", spec, 30, saves=True)
    figure = modules(read_history(tmp_path))
    assert len(figure.axes) == len(read_history(tmp_path).outputs)


def test_a_module_of_one_stream_alone_is_shown_with_all_that_its_candidate_said(tmp_path):
    heard = {}
    for algorithm in ("progress", "2.0"):
        run = tmp_path / algorithm
        run.mkdir()
        table = {"algorithm": algorithm}
        written = write_run(
            run / "run.mcap",
            VECTOR,
            30,
            saves=True,
            learner=table,
            edit=lambda r: dataclasses.replace(r, stream=0),
        )
        heard[algorithm] = read_history(run).outputs[1].t[0]
    said = [r for r in written if np.isfinite(r.y).all()]
    first_save = next(r.t for r in written if r.saved)
    assert heard["progress"] == said[0].t
    assert heard["2.0"] == next(r.t for r in said if r.t > first_save)
