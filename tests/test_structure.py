"""The project's shape: layers, packages, a quick command line, pages that cannot drift."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from sources import PRODUCT, ROOT
from waiting import python

from cdmisfa.cli.app import COMMANDS


def inits(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("__init__.py"))


HEAVY = ("numpy", "_cffi_backend", "rerun", "pybullet", "matplotlib", "pyarrow", "mcap", "rich")


FORBIDDEN = {
    "cdmisfa": ("cdmisfa.cli.app",),
    "cdmisfa.agents": ("cdmisfa.experiments.session", "replay.palette", "recorder.config", "mcap"),
    "cdmisfa.cli": ("rerun", "mcap", "pybullet"),
    "cdmisfa.cli.commands": ("rerun", "mcap", "pybullet"),
    "cdmisfa.core": ("cdmisfa.features.sfa", "recorder.config", "replay.palette", "rerun"),
    "cdmisfa.estimators": ("cdmisfa.experiments.session", "replay.palette", "recorder.config"),
    "cdmisfa.experiments": ("cdmisfa.studies.paper.reproduce", "cdmisfa.cli.app"),
    "cdmisfa.agents.progress": ("cdmisfa.experiments.session", "replay.palette", "rerun"),
    "cdmisfa.features": ("cdmisfa.agents.learner", "replay.palette", "pybullet"),
    "cdmisfa.public": ("cdmisfa.studies.demo", "cdmisfa.cli.app"),
    "cdmisfa.studies": ("cdmisfa.cli.app",),
    "cdmisfa.studies.paper": ("cdmisfa.studies.demo", "cdmisfa.cli.app"),
    "cdmisfa.kernels": ("cdmisfa.features.sfa", "recorder.config", "replay.palette"),
    "cdmisfa.presets": ("cdmisfa.core.config",),
    "recorder": ("replay.palette", "cdmisfa.agents.learner", "cdmisfa.features.sfa", "rerun"),
    "recorder.cameras": ("recorder.recording", "replay.palette", "cdmisfa.agents.learner", "rerun"),
    "recorder.images": ("recorder.log.logfile", "recorder.cameras.live", "replay.palette"),
    "recorder.log": ("recorder.recording", "replay.palette", "cdmisfa.agents.learner"),
    "recorder.mcap": ("recorder.log.logfile", "recorder.world.scenes", "replay.storage.paths"),
    "recorder.world": ("recorder.log.logfile", "replay.palette", "cdmisfa.features.sfa", "mcap"),
    "recorder.world.icub": ("recorder.log.logfile", "replay.palette", "mcap"),
    "replay": ("cdmisfa.agents.learner", "cdmisfa.features.sfa", "recorder.world.icub.world"),
    "replay.corpus": ("replay.viewer", "cdmisfa.experiments.session", "rerun"),
    "replay.episodes": ("replay.viewer", "cdmisfa.agents.learner", "rerun"),
    "replay.export": ("replay.view.build", "replay.integrity.info", "rerun"),
    "replay.integrity": ("replay.export.frames", "replay.viewer", "rerun"),
    "replay.logs": ("replay.open_sources", "replay.view.build", "recorder.recording", "rerun"),
    "replay.logs.formats": ("replay.open_sources", "replay.runs.log", "recorder.recording"),
    "replay.report": ("replay.view.build", "replay.export.frames", "rerun"),
    "replay.runs": ("replay.logs.source", "replay.view.build", "cdmisfa.agents.learner"),
    "replay.storage": ("replay.runs.log", "recorder.config", "rerun"),
    "replay.view": ("replay.viewer", "replay.export.frames", "pybullet"),
}
"""Imports that each room must not have, of which the rules must catch every single one."""


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    code = (
        "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"
    )
    return python(
        "-c", code, cwd=root, env={**os.environ, "PYTHONPATH": str(root), "COLUMNS": "200"}
    )


def test_imports_run_one_way_and_never_in_a_circle() -> None:
    done = lint_imports(ROOT)
    assert done.returncode == 0, done.stdout


def test_every_room_has_forbidden_imports_that_the_rules_catch(tmp_path: Path) -> None:
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for package in PRODUCT:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("*.pyc"))
    rooms = {".".join(f.parent.relative_to(ROOT).parts) for p in PRODUCT for f in inits(p)}
    assert rooms == set(FORBIDDEN)
    probes = []
    for room, targets in FORBIDDEN.items():
        for number, target in enumerate(targets):
            probe = tmp_path.joinpath(*room.split("."), f"probe_{number}.py")
            probe.write_text(f"import {target}\n")
            probes.append((f"{room}.{probe.stem}", target))
    with (tmp_path / "replay" / "storage" / "location.py").open("a") as file:
        file.write("\ndef probe() -> None:\n    import replay.storage.paths\n")
    done = lint_imports(tmp_path)
    assert done.returncode == 1
    assert "No cycles are allowed in replay.storage." in done.stdout
    caught = [(f"{name} -> {target} (l.1)", f"- {name}\n") for name, target in probes]
    assert [lines[0] for lines in caught if not any(line in done.stdout for line in lines)] == []


def test_importing_the_library_imports_nothing_heavy() -> None:
    code = f"import cdmisfa, sys; print(sorted(set({HEAVY!r}) & set(sys.modules)))"
    assert python("-c", code).stdout.strip() == "[]"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from cdmisfa.cli import run; from cdmisfa.cli.app import COMMANDS;"
        "[run([*name, '--help']) for name in ((), *zip(COMMANDS))];"
        f"print(sorted(set({HEAVY!r}) & set(sys.modules)), file=sys.stderr)"
    )
    assert python("-c", code).stderr.strip() == "[]"


def test_learning_from_a_scene_without_a_view_imports_no_viewer(tmp_path: Path) -> None:
    words = ["learn", "oscillatory", "-o", str(tmp_path / "run"), "--max-iterations", "1"]
    code = (
        f"import sys; from cdmisfa.cli import run; assert run({[*words, '--no-rerun']}) == 0\n"
        "heavy = {'rerun', 'matplotlib', 'pybullet', 'replay.logs.source'}\n"
        "print(heavy & sys.modules.keys(), file=sys.stderr)"
    )
    assert python("-c", code, check=True).stderr.splitlines()[-1] == "set()"


def test_every_command_is_on_the_cheat_sheet() -> None:
    text = (ROOT / "docs" / "cheat-sheet.md").read_text("utf-8")
    assert [name for name in COMMANDS if f"cdmisfa {name}" not in text] == []
