"""Frozen modules are applied to other logs, with the bits that they give themselves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from applied_data import SIZE, TAU, camera, learned, make_run
from camera_files import pictures
from conftest import Cdmisfa
from folders import external
from mcap.reader import make_reader
from view_data import View, scalars
from waiting import started

from cdmisfa import Run
from cdmisfa.experiments.apply import Application
from recorder.cameras.stepped import ArraySource
from recorder.recording import record
from replay.runs.modules import save_modules


@pytest.fixture
def run(cdmisfa: Cdmisfa, tmp_path: Path) -> Path:
    """See `make_run`."""
    return make_run(cdmisfa, tmp_path)


def outputs(table: Any, module: int) -> np.ndarray:
    return np.stack([table[f"module{module}_y{j}"].to_numpy() for j in range(3)], axis=1)


@pytest.mark.parametrize("form", ["parquet", "csv"])
@pytest.mark.parametrize(("count", "gap"), [(90, 0), (2000, 0), (90, 3), (21, 0)])
def test_a_table_has_the_bits_of_transform(
    form: str, count: int, gap: int, run: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log, out = camera(tmp_path / "a.mcap", count, gap=gap), tmp_path / f"o.{form}"
    done = cdmisfa("apply", run, log, "-o", out, "--json")
    assert done.code == 0, done.err
    table = pq.read_table(out) if form == "parquet" else pacsv.read_csv(out)
    assert done.json["logs"][0]["frames"] == len(table) == count
    shown = np.stack(list(pictures(count)))
    for module in Run(run).modules:
        np.testing.assert_array_equal(outputs(table, module.index), module.transform(shown))
    assert np.unique(table["log_time"].to_numpy()).size == count
    for name in ("module1_novelty", "module2_block_slowness0"):
        each = np.array(table[name].to_pylist(), float)
        starts = [0, *(np.flatnonzero(np.diff(table["t"].to_numpy() // TAU)) + 1)]
        assert all(len(set(part[:5])) == 1 for part in np.split(each, starts[1:]))
    assert table["module1_novelty"].null_count == (count == 21)  # a block of one frame


@pytest.mark.parametrize("gap", [0, 3])
def test_the_printed_numbers_follow_from_the_table(
    gap: int, run: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log, out = camera(tmp_path / "a.mcap", 90, gap=gap), tmp_path / "o.parquet"
    (result,) = cdmisfa("apply", run, log, "-o", out, "--json").json["logs"]
    table = pq.read_table(out).to_pandas()
    parts = np.flatnonzero(np.diff(table["t"] // TAU)) + 1
    for printed, module in zip(result["modules"], Run(run).modules, strict=True):
        name = f"module{module.index}"
        y, t = table[f"{name}_y0"].to_numpy(), table["t"].to_numpy()
        steps = np.diff(y)[np.diff(t) == 1]
        whole = np.sqrt((steps**2).mean() / y.var()) / (2 * np.pi)
        assert printed["slowness"] == pytest.approx(whole, rel=1e-9)
        assert printed["alive"] == pytest.approx(table[f"{name}_alive"].mean())
        novelty = table[f"{name}_novelty"]
        assert printed["explained"] == pytest.approx((novelty <= 1)[novelty.notna()].mean())
        of_all = table[[f"{name}_y{j}" for j in range(len(module.phi))]].to_numpy()
        ends, squares = [*parts.tolist(), len(y)], []
        for low, high in zip([0, *parts.tolist()], ends, strict=True):
            squares += [(np.diff(of_all[low:high], axis=0) ** 2).mean(axis=0)] * (high - low)
            power, moved = (of_all[:high] ** 2).mean(axis=0), np.mean(squares, axis=0)
            speed = np.log(np.sqrt(moved) / (2 * np.pi * module.eta))
            expected = max(np.abs(np.log10(power)).mean(), np.abs(speed).mean() / 0.8)
            np.testing.assert_allclose(novelty[low:high], expected, rtol=1e-9)


def test_a_covered_camera_is_novel(run: Path, cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    for name, band in (("progress", np.nan), ("2.0", 0.01)):
        modules = [replace(learned(1), band_sd=np.full(3, band))]
        save_modules(run / "modules.npz", modules)
        out = tmp_path / f"{name}.parquet"
        np.save(tmp_path / "dark.npy", np.full((60, *SIZE), 7, np.uint8))
        done = cdmisfa("apply", run, tmp_path / "dark.npy", "--rate", 30, "-o", out, "--json")
        assert done.json["logs"][0]["modules"][0]["explained"] == 0.0, done.err
        assert done.json["logs"][0]["modules"][0]["slowness"] is None
        assert (pq.read_table(out)["module1_novelty"].to_numpy() > 1).all()


def test_an_mcap_has_a_topic_a_module_beside_the_frames(
    run: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log, out = camera(tmp_path / "a.mcap", 50), tmp_path / "o.mcap"
    assert cdmisfa("apply", run, log, "-o", out).code == 0
    from recorder.images.options import InputOptions
    from replay.open_sources import open_log

    frames = external(log, size=SIZE).take(0, 50).frames
    again = external(out, ["/view/cam"]).take(0, 50).frames
    np.testing.assert_array_equal(again, frames)
    for module in Run(run).modules:
        options = InputOptions(topics=(f"/module{module.index}/cam",), fields=("y",))
        y = open_log([out], options).take(0, 50).frames
        np.testing.assert_array_equal(y, module.transform(frames))
    with out.open("rb") as file:
        times = [m.log_time for _, c, m in make_reader(file).iter_messages() if "1/cam" in c.topic]
    assert times == [(1000 + 20 * i) * 10**6 for i in range(50)]
    assert cdmisfa("verify", out).code == 0


@pytest.mark.parametrize("gap", [0, 3])
def test_a_view_has_the_outputs_beside_the_pictures(
    gap: int, run: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log, out = camera(tmp_path / "a.mcap", 90, gap=gap), tmp_path / "o.rrd"
    assert cdmisfa("apply", run, log, "-o", out).code == 0
    applied = list((application := Application(run)).to(application.open([str(log)])))
    view, frames = View(out), np.concatenate([np.arange(len(a.y)) + a.block.t for a in applied])
    y = np.concatenate([a.y for a in applied])
    for i, own in enumerate((slice(0, 3), slice(3, 6)), 1):
        rows = view.rows[f"/outputs/1_cam/{i}"]
        result = scalars(rows)
        there = ~np.isnan(result[:, 0])  # a row of NaN ends lines where a gap begins
        np.testing.assert_array_equal(result[there], y[:, own])
        assert np.count_nonzero(~there) == bool(gap)
        assert (
            np.array(view.rows[f"/outputs/1_cam/{i}"]["frame"])[there].tolist() == frames.tolist()
        )
    begins = [a.block.t for a in applied]
    for name in ("block_slowness", "novelty"):
        reported = view.rows[f"/{name}/1_cam"]
        values = dict(zip(reported["frame"], scalars(reported).tolist(), strict=True))
        columns = [0, 3] if name == "block_slowness" else [0, 1]
        assert [values[t] for t in begins] == [getattr(a, name)[columns].tolist() for a in applied]
    assert view.rows["/views/1_cam"]["frame"] == [t for t in frames.tolist() if t % 10 == 0]


def test_what_is_applied_does_not_depend_on_where_the_frames_come_from(
    run: Path, tmp_path: Path
) -> None:
    """From an array that ends within a block, its recording, and that as another's log."""
    shown = np.stack(list(pictures(150)))[:, ::2, ::2].copy()
    record(ArraySource({"cam": shown}), tmp_path / "rec", frames=150)
    application = Application(run)
    sources = [
        ArraySource({"cam": iter(shown)}),
        application.open([str(tmp_path / "rec")]),
        external(tmp_path / "rec" / "cam.mcap", ["/view/cam"]),
    ]
    result = [list(application.to(source)) for source in sources]
    assert [len(one.block) for one in result[0]] == [TAU] * 7 + [10]
    for each in zip(*result, strict=True):
        for one in each[1:]:
            for name in ("y", "block_slowness", "alive", "novelty"):
                np.testing.assert_array_equal(getattr(one, name), getattr(each[0], name))


LIVE = "av:lavfi:testsrc=size=160x120:rate=30"


def test_lines_come_block_by_block_and_are_those_of_what_was_recorded(
    run: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    out = tmp_path / "o.mcap"
    done = cdmisfa("apply", run, LIVE, "--frames", 50, "--to", "stdout", "-o", out)
    assert done.code == 0, done.err
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert [(line["t"], line["frames"]) for line in lines] == [(0, 20), (20, 20), (40, 10)]
    source = external(out, ["/view/lavfi_testsrc"])
    assert source.spec.frame_shape == SIZE
    recorded = list(Application(run).to(source))
    for line, applied in zip(lines, recorded, strict=True):
        assert line["log_time"] == source.spec.time_ns(applied.block.t)
        y = np.concatenate([module["y"] for module in line["modules"]], axis=1)
        np.testing.assert_array_equal(y, applied.y)
        slowness = np.concatenate([module["block_slowness"] for module in line["modules"]])
        np.testing.assert_array_equal(slowness, applied.block_slowness)
        assert [module["novelty"] for module in line["modules"]] == applied.novelty.tolist()
        assert [module["alive"] for module in line["modules"]] == applied.alive.tolist()


def test_a_reader_that_goes_away_ends_it(run: Path) -> None:
    with started("apply", run, LIVE, "--to", "stdout") as command:
        assert command.stdout is not None
        assert command.stderr is not None
        assert json.loads(command.stdout.readline())["frames"] == TAU
        command.stdout.close()
        assert command.wait(30) == 1
        assert "Traceback" not in command.stderr.read()


def test_a_table_is_read_at_the_times_of_the_run(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    rows = "".join(f"{i / 30:.6f},{np.sin(i / 9) + i % 3 / 10}\n" for i in range(600))
    (tmp_path / "t.csv").write_text("stamp,a\n" + rows)
    settings = ("--set", "input.time=stamp", "--set", "input.holdout=0", "--max-iterations", 600)
    cdmisfa("learn", tmp_path / "t.csv", *settings, "-o", tmp_path / "run", "--no-rerun")
    named = cdmisfa("apply", tmp_path / "run", tmp_path / "t.csv", *settings[:2], "--json")
    applied = cdmisfa("apply", tmp_path / "run", tmp_path / "t.csv", "--json")
    assert applied.json == named.json
    assert (applied.json["logs"][0]["notes"], applied.json["logs"][0]["frames"]) == ([], 600)


def test_outputs_of_infinite_slowness_are_null_in_json_and_raise_no_warning(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    slow = np.sin(np.arange(6000) / 60) + np.random.default_rng(1).normal(0, 0.01, 6000)
    np.save(tmp_path / "joints.npy", np.stack([slow, 2 * slow + 1], axis=1))
    log, run = tmp_path / "joints.npy", tmp_path / "run"
    assert cdmisfa("learn", log, "-o", run, "--set", "learner.expansion=none").code == 0
    assert np.isinf(Run(run).modules[0].eta[1])
    text = (run / "run.json").read_text()
    stated = json.loads(text, parse_constant=pytest.fail)["result"]
    assert stated["modules"][0]["eta"][1] is None
    assert cdmisfa("verify", run).code == 0
    done = cdmisfa("apply", run, log, "-o", tmp_path / "out.csv")
    assert (done.code, done.err) == (0, "")
