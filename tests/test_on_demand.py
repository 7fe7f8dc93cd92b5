"""Packages whose names are imported when they are used."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
from waiting import python

from cdmisfa.cli.on_demand import names_on_demand

FILES = {
    "__init__": """
from . import inner
from .large import LARGE, Large as Great
from .other import other
from .small import SMALL
TWICE = [SMALL, SMALL]
def __getattr__(name):
    if name == "old":
        return "its own"
    raise AttributeError(name)
""",
    "large": "from many_names import TWICE\nLARGE, Large = len(TWICE), dict",
    "small": "SMALL = 1",
    "other": "from . import circle\nother = circle",
    "circle": "from .other import missing",
    "inner/__init__": "from .deep import DEEP\nfrom many_names import LARGE",
    "inner/deep": "DEEP = 3",
}


@pytest.fixture
def loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    package = tmp_path / "many_names"
    (package / "inner").mkdir(parents=True)
    for name, text in FILES.items():
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    monkeypatch.setattr(sys, "modules", sys.modules.copy())
    names_on_demand("many_names")
    return package


def test_a_module_is_imported_when_a_name_of_it_is_used(loaded: Path) -> None:
    many = importlib.import_module("many_names")
    assert (many.TWICE, "many_names.large" in sys.modules) == ([1, 1], False)
    assert (many.Great, many.LARGE, many.old) == (dict, 2, "its own")
    assert many.large is sys.modules["many_names.large"]
    assert "many_names.inner" not in sys.modules
    assert many.inner.LARGE == 2
    assert "many_names.inner.deep" not in sys.modules
    assert many.inner.DEEP == 3
    assert many.inner.deep.DEEP == 3


def test_what_is_not_there_is_said_as_ever(loaded: Path) -> None:
    many = importlib.import_module("many_names")
    for module, name in ((many, "none"), (many.inner, "none")):
        with pytest.raises(AttributeError, match="none"):
            getattr(module, name)
    with pytest.raises(ImportError, match="missing"):
        _ = many.other
    (loaded / "other.py").write_text("other = 5")
    importlib.invalidate_caches()
    names: dict[str, object] = {}
    exec("from many_names import *", names)
    assert {"LARGE", "Great", "SMALL", "TWICE", "inner", "other"} <= names.keys()


def test_a_view_is_written_without_most_of_rerun(tmp_path: Path) -> None:
    program = (
        "import atexit, sys\n"
        "def tell():\n"
        "    wanted = ('rerun', 'rerun.archetypes.capsules3d')\n"
        "    compute = 'pyarrow.compute' in sys.modules\n"
        "    by_us = compute and 'pandas' not in sys.modules\n"  # pandas imports it
        "    print(*(name in sys.modules for name in wanted), by_us, file=sys.stderr)\n"
        "atexit.register(tell)\n"
        "from cdmisfa.cli import main\n"
        "main()\n"
    )
    words = ["learn", "oscillatory", "--max-iterations", "1", "-o", str(tmp_path / "run")]
    done = python("-c", program, *words, check=True)
    assert done.stderr.splitlines()[-1] == "True False False"
    assert (tmp_path / "run" / "run.rrd").stat().st_size > 0


def test_a_scene_is_learned_from_without_views_and_what_reads_logs_of_others(
    tmp_path: Path,
) -> None:
    words = ["learn", "oscillatory", "-o", str(tmp_path / "run"), "--max-iterations", "1"]
    program = (
        "import sys\n"
        "from cdmisfa.cli import run\n"
        f"assert run({[*words, '--no-rerun']}) == 0\n"
        "wanted = {'rerun', 'matplotlib', 'pybullet', 'replay.camera_logs.source'}\n"
        "print(wanted & sys.modules.keys(), file=sys.stderr)\n"
    )
    done = python("-c", program, check=True)
    assert done.stderr.splitlines()[-1] == "set()"
