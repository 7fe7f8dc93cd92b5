"""The figures of a run are drawn, show what they should, and are the same every time."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from run_data import IMAGE, VECTOR, write_run

from cdmisfa.core.errors import UsageError
from replay.export import figures
from replay.export.figures import decision, draw_figures, polynomial_fit
from replay.export.history import Output, read_history


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


def test_a_run_without_iterations_or_modules_is_drawn(tmp_path):
    for count in (0, 1):
        folder = tmp_path / str(count)
        folder.mkdir()
        write_run(folder / "run.mcap", VECTOR, count)
        names = {f.stem for f in draw_figures(folder)}
        assert names == ({"convergence", "decision"} if count else set())


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


def test_an_output_finds_the_truth_it_follows():
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((500, 3))
    y = -2 * truth[:, 1] + 0.01 * rng.standard_normal(500)
    output = Output(1, 0, np.arange(500), y, np.column_stack([truth, np.ones(500)]))
    column, correlation = output.best_truth()
    assert column == 1
    assert correlation < -0.99


def test_the_fit_finds_a_cubic_and_survives_two_places():
    x = np.linspace(-1, 1, 50)
    fit = polynomial_fit(x, 1 + x - 2 * x**3)
    np.testing.assert_allclose(fit(x), 1 + x - 2 * x**3, atol=1e-9)
    places = np.array([0.4, 0.6, 0.4, 0.6])
    fit = polynomial_fit(places, np.array([1.0, 3.0, 1.0, 3.0]))
    np.testing.assert_allclose(fit(np.array([0.4, 0.6])), [1.0, 3.0])
