"""Configuration: strict keys and types, presets with sources, round trips."""

from __future__ import annotations

import dataclasses
import inspect
import re
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.config import (
    LearnerConfig,
    build,
    load_preset,
    parse_settings,
    presets,
    section_table,
)
from cdmisfa.core.errors import UsageError
from recorder.config import RecordConfig
from recorder.images.options import InputConfig
from recorder.world.icub.config import IcubConfig
from recorder.world.oscillatory import OscillatoryConfig

DOCS = Path(__file__).parents[1] / "docs"
KEYS = [f.name for f in dataclasses.fields(LearnerConfig)]


@dataclass(frozen=True)
class Inner:
    size: tuple[int, int] = (4, 8)
    names: tuple[str, ...] = ("left",)


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    on: bool = False
    seed: int | None = None
    kind: Literal["a", "b"] = "a"


def learner(**values: Any) -> LearnerConfig:
    return build(LearnerConfig, "learner", values)


WRONG = {
    "far from all": (
        Outer,
        {"zzzz": 1},
        "unknown key scene.zzzz: choose from inner, on, seed, kind",
    ),
    "near": (LearnerConfig, {"epsilon_dekay": 1}, "did you mean learner.epsilon_decay?"),
    "number": (LearnerConfig, {"nu": "fast"}, "learner.nu is 'fast': it must be a number"),
    "nan": (LearnerConfig, {"nu": "nan"}, "learner.nu is 'nan': it must be a number"),
    "truth": (LearnerConfig, {"nu": True}, "learner.nu is True: it must be a number"),
    "whole": (LearnerConfig, {"tau": 40.0}, "learner.tau is 40.0: it must be a whole number"),
    "huge": (LearnerConfig, {"tau": 10**30}, "it must be a whole number"),
    "none": (LearnerConfig, {"tau": None}, "learner.tau is None: it must be a whole number"),
    "text": (LearnerConfig, {"algorithm": 3}, "learner.algorithm is 3: it must be a text"),
    "auto": (LearnerConfig, {"beta": "x"}, "learner.beta is 'x': it must be a number or auto"),
    "beyond another": (LearnerConfig, {"outputs": 6}, "learner.outputs is 6: it must be in [1, 5]"),
    "table": (Outer, {"inner": 3}, "scene.inner is not a value but a table"),
    "inner": (Outer, {"inner.siz": 3}, "scene.inner.siz: did you mean scene.inner.size?"),
    "no table": (Outer, {"on.x": 1}, "unknown key scene.on.x: did you mean scene.on?"),
    "length": (Outer, {"inner.size": "1,2,3"}, "it must be a list, 2 values, each a whole number"),
    "list": (Outer, {"inner.size": "1,x"}, "scene.inner.size is '1,x': it must be a list"),
    "boolean": (Outer, {"on": "maybe"}, "scene.on is 'maybe': it must be true or false"),
    "choice": (Outer, {"kind": "c"}, "scene.kind is 'c': it must be one of a, b"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_is_named(case: str) -> None:
    section, values, words = WRONG[case]
    with pytest.raises(UsageError, match=re.escape(words)):
        build(section, "scene" if section is Outer else "learner", values)
    if section is LearnerConfig and set(values) <= set(KEYS):
        with pytest.raises(UsageError, match=re.escape(words)):
            LearnerConfig(**values)


OUT_OF_RANGE = """nu=0 nu=-1 nu=inf nu=1.01 nu=1e300 delta=0 sigma=-1e-9 beta=inf beta=-0.1 tau=2
components=0 gamma=1 gamma=-0.1 epsilon_decay=1.01 epsilon_knee=inf novel_share=1.5
gate_window=0 warm_up=-1 patience=0"""


@pytest.mark.parametrize("word", OUT_OF_RANGE.split())
def test_values_out_of_range_name_the_key_and_the_range(word: str) -> None:
    sections = parse_settings([f"learner.{word}"])
    with pytest.raises(UsageError, match=rf"learner\.{word.partition('=')[0]} is .* must be in"):
        build(LearnerConfig, "learner", sections["learner"])


def test_values_and_texts_get_the_fields_type_and_the_last_layer_wins() -> None:
    layers = ({"nu": 0.1, "tau": 10, "beta": 0.1}, {"nu": "0.02", "tau": "40"}, {"beta": "auto"})
    assert build(LearnerConfig, "learner", *layers) == learner(nu=0.02, tau=40)
    for word in ("none", None):
        assert learner(beta=word).beta is None  # the paper's
    config = LearnerConfig(tau=np.int64(40), nu=1)
    assert (type(config.tau), type(config.nu)) == (int, float)
    outer = build(
        Outer, "scene", {"inner": {"size": [1, 2]}}, {"inner.names": "left, right", "on": "true"}
    )
    assert outer == Outer(Inner((1, 2), ("left", "right")), on=True)
    changed = build(Outer, "scene", {"inner.size": "(3,4)"}, base=outer)
    assert changed.inner == Inner((3, 4), ("left", "right"))


@given(
    st.builds(
        Outer,
        st.builds(
            Inner,
            st.tuples(st.integers(0, 99), st.integers(0, 99)),
            st.lists(st.text(max_size=5), max_size=3).map(tuple),
        ),
        st.booleans(),
        st.none() | st.integers(0, 2**63 - 1),
        st.sampled_from(["a", "b"]),
    )
)
def test_as_table_and_build_are_inverse(outer: Outer) -> None:
    assert build(Outer, "scene", section_table(outer)) == outer


@given(
    st.builds(
        LearnerConfig,
        nu=st.floats(1e-6, 1),
        tau=st.integers(3, 1000),
        beta=st.none() | st.floats(0, 10),
        sigma=st.floats(0, 1),
    )
)
def test_a_learners_table_survives_json_and_texts(config: LearnerConfig) -> None:
    table = section_table(config)
    assert list(table) == KEYS
    assert build(LearnerConfig, "learner", table) == config
    assert build(LearnerConfig, "learner", {k: str(v) for k, v in table.items()}) == config


@pytest.mark.parametrize("name", ["icub", "oscillatory"])
def test_presets_hold_every_key_with_its_source(name: str) -> None:
    text = resources.files("cdmisfa.presets").joinpath(f"{name}.toml").read_text("utf-8")
    assert name in presets()
    section, seen = "", []
    for line in text.splitlines():
        if match := re.fullmatch(r"\[(\w+)\]", line):
            section = match[1]
        elif match := re.match(r"(\w+) = ", line):
            assert re.search(r" # \w", line), f"{name}: no comment: {line}"
            if section == "learner":
                assert re.search(r"# (paper, \S|decision \d{4}|our choice\b)", line), (
                    f"{name}: no source: {line}"
                )
                seen.append(match[1])
    assert seen == KEYS
    page = (DOCS / "project" / "decisions.md").read_text("utf-8")
    decisions = set(re.findall(r"^\| \**(\d{4})\** \|", page, re.MULTILINE))
    assert set(re.findall(r"decision (\d{4})", text)) <= decisions


def test_the_defaults_and_the_papers_constants() -> None:
    oscillatory = build(LearnerConfig, "learner", load_preset("oscillatory")["learner"])
    icub = build(LearnerConfig, "learner", load_preset("icub")["learner"])
    assert oscillatory == learner() == LearnerConfig()
    values = [(c.nu, c.tau, c.sigma, c.delta, c.epsilon_start) for c in (oscillatory, icub)]
    assert values == [(0.05, 100, 0.0009, 0.0006, 1.2), (0.01, 40, 0.01, 0.0008, 1.2)]
    assert (oscillatory.expansion, icub.expansion) == ("quadratic", "none")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"nu = 1\n", "nu is outside of any .section"),
        (b"[learner\n", "not a preset, which is a TOML file"),
        (b"\xff\xfe", "not a preset, which is a TOML file"),
        (b"[learner]\nnu = " + b"[\n" * 2000 + b"]\n" * 2000, "recursion"),
        (b"[learner]\ntau = " + b"1" * 5000 + b"\n", "Exceeds the limit"),
        (b"# comment\n" * 100_000, "1000000 bytes, above the limit"),
        (None, "No such file"),
    ],
    ids=["section", "open", "binary", "nested", "digits", "size", "missing"],
)
def test_presets_from_files(tmp_path: Path, content: bytes | None, words: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[learner]\nnu = 0.5\n")
    assert load_preset(str(file)) == {"learner": {"nu": 0.5}}
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UsageError, match=words) as caught:
        load_preset(str(file))
    message = str(caught.value).replace(str(tmp_path), "")
    assert len(message) < 700
    assert "\n" not in message


def test_settings_are_section_key_value() -> None:
    words = ["learner.nu=0.02", "scene.inner.size = 1,2", "learner.nu=0.03"]
    assert parse_settings(words) == {"learner": {"nu": "0.03"}, "scene": {"inner.size": "1,2"}}
    for word in ("nu=1", "learner.nu", "learner.=1", ".nu=1", "", "="):
        with pytest.raises(UsageError, match=r"section\.key=value"):
            parse_settings([word])


@given(st.text(max_size=20), st.sampled_from(KEYS))
def test_any_text_is_a_value_or_a_plain_error(text: str, key: str) -> None:
    try:
        value = getattr(learner(**{key: text}), key)
    except UsageError as error:
        message = str(error)
    else:
        message = f"learner.{key} is {value}"
    assert message.startswith(f"learner.{key} is")


@pytest.mark.parametrize(
    "section",
    [LearnerConfig, ProgressConfig, RecordConfig, InputConfig, IcubConfig, OscillatoryConfig],
)
def test_docstrings_tell_every_key(section: type) -> None:
    """The page of keys is made of them."""
    docstrings = "".join(inspect.getdoc(each) or "" for each in section.__mro__)
    for key in dataclasses.fields(section):
        if isinstance(key.default_factory, type):
            test_docstrings_tell_every_key(key.default_factory)
        else:
            assert f"\n    {key.name}: " in docstrings, key.name
