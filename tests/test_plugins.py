"""Parts of other packages: found by name, loaded when needed, refused in words."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Cdmisfa, Outcome
from folders import contents
from PIL import Image
from waiting import python

from cdmisfa.agents.learners import LEARNERS
from cdmisfa.core.errors import UsageError
from cdmisfa.core.registry import Registry
from cdmisfa.experiments.sources import configure
from cdmisfa.experiments.store import read_rows
from cdmisfa.experiments.sweep import plan, sweep
from recorder import RecordConfig, open_scene, record, record_scene
from recorder.cameras.words import CAMERAS
from recorder.world.scenes import SCENES
from replay.export.forms import FORMS
from replay.runs.keyframes import read_keyframe

ROOT = Path(__file__).parents[1]
TOY = ROOT / "tests" / "toy_plugin"
LEFT, RIGHT = (ROOT / "sample_logs" / "icub" / f"{name}.mcap" for name in ("left", "right"))
NAMES: tuple[tuple[Registry[object], tuple[str, ...]], ...] = (
    (SCENES, ("swings",)),
    (CAMERAS, ("bars",)),
    (LEARNERS, ("watcher", "broken")),
    (FORMS, ("contact", "rewards", "images")),
)


def install(folder: Path, name: str, version: str, groups: dict[str, dict[str, str]]) -> None:
    """What pip leaves of a package in an environment, its modules aside."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [
        f"[{group}]\n" + "".join(f"{key} = {place}\n" for key, place in entries.items())
        for group, entries in groups.items()
    ]
    (info / "entry_points.txt").write_text("\n".join(lines))


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of packages with the toy in it, as its pyproject.toml says."""
    folder = tmp_path / "packages"
    folder.mkdir()
    (folder / "cdmisfa_toy").symlink_to(TOY / "cdmisfa_toy")
    project = tomllib.loads((TOY / "pyproject.toml").read_text())["project"]
    install(folder, project["name"], project["version"], project["entry-points"])
    monkeypatch.syspath_prepend(folder)
    before = [dict(registry) for registry, _ in NAMES]
    yield folder
    for (registry, _), known in zip(NAMES, before, strict=True):
        for name in set(registry) - set(known):
            registry.remove(name)
    for module in [name for name in sys.modules if name.startswith("cdmisfa_toy")]:
        del sys.modules[module]


@pytest.mark.usefixtures("environment")
def test_nothing_of_a_plugin_is_imported_before_it_is_asked_for(cdmisfa: Cdmisfa) -> None:
    assert "watcher" in LEARNERS
    assert "watcher" not in list(LEARNERS)
    assert cdmisfa("learn", "oscillatory", "--max-iterations", 1).code == 0
    assert not [name for name in sys.modules if name.startswith("cdmisfa_toy")]
    assert LEARNERS["watcher"].configuration.__name__ == "WatcherConfig"
    assert list(LEARNERS)[-1] == "watcher"
    hint = cdmisfa("learn", "oscillatory", "--algorithm", "wacher").err
    assert "did you mean watcher?" in hint


@pytest.mark.usefixtures("environment")
def test_a_plugins_scene_is_recorded_and_learned_from(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    rec, words = tmp_path / "rec", ("--max-iterations", 6, "--no-rerun", "--json")
    scene = ("--seed", 2, "--set", "scene.period=120")
    done = cdmisfa("record", "swings", "-o", rec, "--frames", 200, *scene, "--json")
    assert [view["name"] for view in done.json["views"]] == ["quick", "slow"], done.err
    assert b"version_cdmisfa-toy" in (rec / "quick.mcap").read_bytes()
    live = cdmisfa("learn", "swings", *scene, *words, "-o", tmp_path / "live")
    recorded = cdmisfa("learn", rec, "--seed", 2, *words)
    assert live.json["signals_sha256"] == recorded.json["signals_sha256"]
    manifest = json.loads((tmp_path / "live" / "run.json").read_text())
    assert manifest["versions"]["cdmisfa-toy"] == "1.2"
    assert manifest["config"]["scene"] == {"kind": "swings", "seed": 2, "period": 120.0}


@pytest.mark.usefixtures("environment")
def test_processes_change_no_byte_of_a_plugins_scene(tmp_path: Path) -> None:
    config = SCENES["swings"].config(seed=1)
    for jobs in (1, 2):
        record_scene("swings", tmp_path / f"{jobs}", config, frames=300, jobs=jobs)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


@pytest.mark.usefixtures("environment")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("learn", "swings", "--set", "scene.perod=3"), "did you mean scene.period?"),
        (("learn", "swings", "--set", "scene.streams=x1"), "means nothing to the scene swings"),
        (("learn", "icub", "--set", "scene.period=3"), "means nothing to the scene icub"),
        (("learn", "swings", "--set", "scene.seed=-1"), "scene.seed is -1"),
        (("record", "swing", "-o", "x"), "no scene 'swing': did you mean swings?"),
        (("record", "swings", "--scene-picture", "x.png"), "--scene-picture is for icub"),
    ],
)
def test_keys_of_a_plugins_scene_are_its_own(
    cdmisfa: Cdmisfa, words: tuple[str, ...], said: str
) -> None:
    assert SCENES["swings"].config().kind == "swings"  # loaded, so that its keys are known
    refused = cdmisfa(*words)
    assert (refused.code, said in refused.err) == (2, True), refused.err


@pytest.mark.usefixtures("environment")
@pytest.mark.parametrize("name", ["oscillatory", "icub", "swings"])
def test_a_source_that_was_opened_by_name_is_recorded_as_by_name(name: str, tmp_path: Path) -> None:
    if name == "icub":
        pytest.importorskip("pybullet")
    clock = RecordConfig(fps=25.0, compression="lz4")
    config = SCENES[name].config(seed=3)
    record_scene(name, tmp_path / "name", config, clock, frames=20)
    with open_scene(name, config, clock) as source:
        record(source, tmp_path / "source", frames=20)
    assert contents(tmp_path / "name") == contents(tmp_path / "source")


@pytest.mark.usefixtures("environment")
def test_a_scene_is_told_by_its_own_configuration_and_added_once(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="oscillatory takes OscillatoryConfig, not Swing"):
        record_scene("oscillatory", tmp_path / "rec", SCENES["swings"].config())
    with pytest.raises(ValueError, match="there is a scene 'icub' already"):
        SCENES.add("icub", SCENES["oscillatory"])


def test_a_run_whose_plugin_is_gone_names_it(
    cdmisfa: Cdmisfa, tmp_path: Path, environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    assert cdmisfa("learn", "swings", "-o", run, "--max-iterations", 2, "--no-rerun").code == 0
    SCENES.remove("swings")
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place != str(environment)])
    refused = cdmisfa("learn", "--resume", "-o", run, "--max-iterations", 4)
    assert refused.code == 2
    assert "learns from swings, which the plugin cdmisfa-toy 1.2 brought: install" in refused.err


@pytest.mark.usefixtures("environment")
def test_a_plugins_camera_is_recorded(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    done = cdmisfa("record", "bars:20", "bars:20", "-o", tmp_path / "rec", "--json")
    assert [view["name"] for view in done.json["views"]] == ["20", "20-2"]
    # It ends with the first of them, when not every picture of the other need have come.
    assert ": 20 pictures;" in done.err
    assert done.err.count(" pictures;") == 2
    refused = cdmisfa("record", "bars:many", "-o", tmp_path / "other")
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert "say how many pictures" in refused.err


@pytest.mark.usefixtures("environment")
def test_a_plugins_learner_learns_and_goes_on_where_it_was(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    words = ("learn", "oscillatory", "--algorithm", "watcher", "--no-rerun", "--json")
    words = (*words, "--set", "learner.patience=9")
    whole = cdmisfa(*words, "-o", tmp_path / "whole").json
    assert (whole["iterations"], whole["ended"]) == (9, "nothing_left")
    cdmisfa(*words, "-o", tmp_path / "parts", "--max-iterations", 4, "--keyframes", 2)
    resumed = cdmisfa(*words, "-o", tmp_path / "parts", "--resume").json
    assert resumed["signals_sha256"] == whole["signals_sha256"]
    assert resumed["mean"] == whole["mean"]
    assert (tmp_path / "parts" / "run.mcap").is_file()
    settings = ("learner.algorithm=watcher", "learner.patience=4")
    swept = tmp_path / "swept"
    sweep("oscillatory", swept, seeds=[0], settings=settings, grid={"learner.tau": [10, 20]})
    assert [row["result"]["frames"] for row in read_rows(swept)] == [40, 80]
    with pytest.raises(UsageError, match=r"learner\.tua: did you mean learner\.tau\?"):
        configure("oscillatory", settings=("learner.algorithm=watcher", "learner.tua=3"))
    preset = tomllib.loads((TOY / "cdmisfa_toy" / "watcher.toml").read_text())["learner"]
    own = configure("oscillatory", settings=settings[:1]).learner
    assert {key: getattr(own, key) for key in preset} == preset


@pytest.mark.usefixtures("environment")
def test_what_is_loaded_but_not_used_changes_nothing(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    def packages(name: str, *words: object) -> set[str]:
        out = tmp_path / name
        done = cdmisfa("learn", *words, "--max-iterations", 2, "--no-rerun", "-o", out)
        assert done.code == 0, done.err
        keyframe = read_keyframe(out / "run.mcap")
        versions = json.loads((out / "run.json").read_text())["versions"]
        assert keyframe is not None
        assert keyframe.versions == versions
        return set(versions)

    def names(*words: str) -> list[str]:
        return [trial.id for trial in plan(["oscillatory"], grid={}, seeds=[0], settings=words)]

    before, own = names(), packages("own", "oscillatory")
    others = {name: registry[name] for registry, known in NAMES for name in known[:1]}
    assert "cdmisfa_toy.camera" in sys.modules
    assert len(others) == 4
    assert names() == before != names("learner.algorithm=watcher")
    assert packages("still own", "oscillatory") == own
    assert packages("learner", "oscillatory", "--algorithm", "watcher") == {*own, "cdmisfa-toy"}
    assert packages("scene", "swings") == {*own, "cdmisfa-toy"}
    cameras = ("bars:60", "--set", "learner.tau=10")
    assert packages("cameras", *cameras) == {*own, "cdmisfa-toy"}


@pytest.mark.usefixtures("environment")
def test_plugins_exports_are_written(
    cdmisfa: Cdmisfa, oscillatory_run: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run.rewards"  # the form is what the name ends in
    done = cdmisfa("export", oscillatory_run, "-o", out)
    assert done.out == f"15 rewards written to {out}\n"
    assert len(out.read_text().splitlines()) == 15
    picture = tmp_path / "all.png"
    done = cdmisfa("export", LEFT, RIGHT, "--to", "contact", "-o", picture)
    assert (done.code, done.out) == (0, f"2 views written to {picture}\n")
    with Image.open(picture) as shown:
        width, height = shown.size
    assert height * 2.5 > width  # one above the other


def test_the_page_shows_what_is_in_the_toy() -> None:
    page = (ROOT / "docs" / "how-to" / "plugins.md").read_text("utf-8")
    files = [*TOY.rglob("*.py"), TOY / "pyproject.toml"]
    code = "\n".join(file.read_text("utf-8") for file in files)
    shown = re.findall(r"^```\w+\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert len(shown) == 6
    assert [block for block in shown if block not in code] == []


def checks(done: Outcome) -> dict[str, tuple[bool, str]]:
    rows = done.json["checks"]
    return {r["what"]: (r["ok"], r["detail"]) for r in rows if r["what"].startswith("plugin ")}


def test_doctor_lists_plugins_and_says_why_one_fails(cdmisfa: Cdmisfa, environment: Path) -> None:
    (environment / "cdmisfa_toy_too.py").write_text("import no_such_package\n")
    install(
        environment,
        "toy-too",
        "0.1",
        {
            "cdmisfa.learners": {"broken": "cdmisfa_toy_too:LEARNER", "2.0": "cdmisfa_toy_too:X"},
            "cdmisfa.exports": {"kind": "cdmisfa_toy.camera:BARS"},
        },
    )
    other = environment / "other"
    other.mkdir()
    install(other, "toy-three", "3", {"cdmisfa.learners": {"broken": "cdmisfa_toy_too:X"}})
    sys.path.insert(0, str(other))
    try:
        with pytest.raises(UsageError, match=r"both .* of toy-three 3 and .* uninstall one"):
            LEARNERS["broken"]
    finally:
        sys.path.remove(str(other))
    done = cdmisfa("doctor", "--json")
    assert done.code == 0
    why = "broken is cdmisfa_toy_too:LEARNER of toy-too 0.1, which fails to load: "
    why += "ModuleNotFoundError: No module named 'no_such_package'"
    kind = "kind is cdmisfa_toy.camera:BARS of toy-too 0.1"
    assert checks(done) == {
        "plugin bars": (True, "cdmisfa_toy.camera:BARS of cdmisfa-toy 1.2"),
        "plugin swings": (True, "cdmisfa_toy.scene:SWINGS of cdmisfa-toy 1.2"),
        "plugin watcher": (True, "cdmisfa_toy.learner:WATCHER of cdmisfa-toy 1.2"),
        "plugin contact": (True, "cdmisfa_toy.export:CONTACT of cdmisfa-toy 1.2"),
        "plugin rewards": (True, "cdmisfa_toy.export:REWARDS of cdmisfa-toy 1.2"),
        "plugin broken": (False, why),
        "plugin 2.0": (
            False,
            "cdmisfa_toy_too:X of toy-too 0.1, which is never used: cdmisfa has its own",
        ),
        "plugin kind": (False, f"{kind}, which is a CameraKind: a Form is needed here"),
    }
    failed = cdmisfa("learn", "oscillatory", "--algorithm", "broken")
    assert (failed.code, failed.err) == (2, f"cdmisfa: {why}\n")
    assert "a Scene is needed here" in cdmisfa("learn", "bars").err
    assert "a CameraKind is needed here" in cdmisfa("learn", "swings:1").err


def test_the_toys_own_tests_pass_with_the_contracts(environment: Path) -> None:
    shutil.copytree(TOY / "tests", environment / "toy_tests")
    found = {**os.environ, "PYTHONPATH": f"{environment}:{ROOT}"}
    words = ("pytest", "-q", "-p", "no:cacheprovider", "toy_tests")
    done = python("-m", *words, env=found, cwd=environment)
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout
    assert "skipped" not in done.stdout
