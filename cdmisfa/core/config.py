"""Configuration: strict frozen dataclasses, filled from TOML presets and `--set` words.

A key that does not exist is an error that names the nearest one that does. Each package owns the
dataclass of its own section (`learner` here, `scene` and `record` in `recorder`); this fills any.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import reprlib
import tomllib
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from operator import index
from pathlib import Path
from typing import Any, Literal, TypeVar

from cdmisfa.core.errors import UsageError, did_you_mean
from cdmisfa.core.untrusted import read_regular

Section = TypeVar("Section")

LN_2 = 0.6931471805599453
LARGEST = 2**63 - 1
"""Largest whole number a key takes."""

MAX_COMPONENTS = 1000
"""More whitening components than this would take minutes a frame."""

MAX_PRESET = 16 * 1024
"""Largest preset, in bytes: keys of many parts take a time that grows with the square of them."""

SHOWN = 120
"""Most characters of a value or key that an error shows."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 3
_SHORT.maxtuple = _SHORT.maxlist = _SHORT.maxdict = 8
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = SHOWN

MAX_TAU = 100_000
"""A block of more frames than this does not fit into memory beside its images."""


@dataclass(frozen=True, slots=True)
class LearnerConfig:
    """Configuration of the paper's learners, 2.0 and 1.0 (keys `learner.*`).

    The defaults are those of the oscillatory experiment; the presets state the sources of values.

    Attributes:
        algorithm: `2.0`, or `1.0` for the older CD-MISFA it is compared with.
        nu: ν, learning rate of the slow features; larger is faster and noisier.
        tau: τ, frames of one block: the agent decides once a block.
        sigma: σ, width of the expert reward: how small a change of φ is mastery; 0: none.
        delta: δ, an abstraction is saved when its slowness changes by less than this (1/frame).
        beta: β, weight of the expert reward; `auto`: ν ln 2 / (2 (n-1)) for n streams.
        components: K, principal components kept when whitening; choose with care on images.
        outputs: J, slow features of one abstraction.
        expansion: `none`, or `quadratic`: inputs and all their products.
        epsilon_start: ε, probability of a random action at first; above 1 counts as 1.
        epsilon_decay: factor of ε in each iteration while it is above `epsilon_knee`.
        epsilon_knee: below this value of ε the tail begins.
        epsilon_tail_decay: factor of ε in each iteration of the tail.
        gamma: γ, discount of future rewards.
        mean_window: window of the input's running mean (frames).
        slowness_window: N, of the mean squared derivative and the recent variance (frames).
        eta_dot_window: w, of the change of slowness, and of `novel_share` (blocks).
        gate_window: w_g, window of the band in which a module's slowness lies (blocks).
        warm_up: novel blocks of a new abstraction before rewards begin.
        min_variance: v_min, least recent variance of an output that may be saved.
        novel_share: least share, of late, of novel blocks of the stream before, for a save.
        patience: iterations without exploration after which a run gives up.
        alpha: α, 1.0 only: rate of the tabular reward.
        roc_centres: 1.0 only: cluster centres for each stream.
        roc_radius: 1.0 only: an output this near to a centre moves it.
        roc_memory: 1.0 only: blocks over which centres fade.
        roc_error: 1.0 only: error below which a module is saved, or knows a block.
    """

    algorithm: str = "2.0"
    nu: float = 0.05
    tau: int = 100
    sigma: float = 0.0009
    delta: float = 0.0006
    beta: float | None = None
    components: int = 5
    outputs: int = 1
    expansion: str = "quadratic"
    epsilon_start: float = 1.2
    epsilon_decay: float = 0.999
    epsilon_knee: float = 0.8
    epsilon_tail_decay: float = 0.95
    gamma: float = 0.99
    mean_window: int = 1000
    slowness_window: int = 600
    eta_dot_window: int = 40
    gate_window: int = 20
    warm_up: int = 80
    min_variance: float = 0.1
    novel_share: float = 0.9
    patience: int = 1000
    alpha: float = 0.005
    roc_centres: int = 10
    roc_radius: float = 0.3
    roc_memory: int = 40
    roc_error: float = 0.1

    def __post_init__(self) -> None:
        from cdmisfa.core.expansion import EXPANSIONS  # with numpy: to name keys needs neither

        convert_fields(self, "learner")
        one_of(self, "learner", EXPANSIONS, "expansion")
        positive(self, "learner", "nu", "delta", "epsilon_start", "mean_window", "slowness_window")
        positive(self, "learner", "tau", "components", "outputs", "eta_dot_window", "gate_window")
        positive(self, "learner", "patience", "roc_centres", "roc_radius", "roc_memory")
        in_range(self, "learner", 0.0, math.inf, "sigma", "warm_up", "min_variance", "roc_error")
        in_range(self, "learner", 0.0, 1.0, "epsilon_decay", "epsilon_tail_decay", "novel_share")
        in_range(self, "learner", 0.0, 1.0, "nu")
        in_range(self, "learner", 1e-6, 1.0, "alpha")
        in_range(self, "learner", 0.0, math.inf, "epsilon_knee")
        in_range(self, "learner", 1, MAX_COMPONENTS, "components")
        in_range(self, "learner", 3, MAX_TAU, "tau")
        in_range(self, "learner", 0.0, 0.999999, "gamma")
        if self.beta is not None:
            in_range(self, "learner", 0.0, math.inf, "beta")
        outputs_within_components(self, "learner")

    def reward_beta(self, n_streams: int) -> float:
        """Weight of the expert reward: as set, or the paper's nu ln 2 / (2 (n-1)).

        Source: paper, Hyper Parameters.
        """
        if self.beta is not None:
            return self.beta
        return self.nu * LN_2 / (2.0 * max(n_streams - 1, 1))


def convert_fields(section: Any, prefix: str) -> None:
    """Give every field of a new dataclass its type, as `build` does; for `__post_init__`.

    Raises:
        UsageError: a value does not fit; it names the key.
    """
    for name, hint in _hints(type(section)).items():
        value = convert_value(getattr(section, name), hint, f"{prefix}.{name}")
        object.__setattr__(section, name, value)


_hints: Any = cache(typing.get_type_hints)


def positive(section: Any, prefix: str, *names: str) -> None:
    """Refuse values that are not above zero and finite, naming the key.

    Raises:
        UsageError: at the first such value.
    """
    for name in names:
        value = getattr(section, name)
        if not (value > 0 and math.isfinite(value)):
            raise UsageError(f"{prefix}.{name} is {value}: it must be above 0 and finite")


def in_range(section: Any, prefix: str, low: float, high: float, *names: str) -> None:
    """Refuse values outside [low, high], naming the key.

    Raises:
        UsageError: at the first such value.
    """
    for name in names:
        value = getattr(section, name)
        if not low <= value <= high or (value == math.inf):
            raise UsageError(f"{prefix}.{name} is {value}: it must be in [{low:g}, {high:g}]")


def one_of(section: Any, prefix: str, choices: Collection[str], *names: str) -> None:
    """Refuse texts that are none of the choices, naming the key and the nearest choice.

    Raises:
        UsageError: at the first such value.
    """
    for name in names:
        value = getattr(section, name)
        if value not in choices:
            raise UsageError(f"{prefix}.{name} is {value}: {did_you_mean(value, choices)}")


def outputs_within_components(section: Any, prefix: str) -> None:
    """Refuse a learner that is to give more slow features than it has components.

    Raises:
        UsageError: it has.
    """
    if section.outputs > section.components:
        raise UsageError(
            f"{prefix}.outputs is {section.outputs}, more than {prefix}.components "
            f"{section.components}: lower the one, or raise the other"
        )


def presets() -> tuple[str, ...]:
    """Names of the presets that come with the package."""
    folder = resources.files("cdmisfa.presets")
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml")))


def load_preset(name: str) -> dict[str, dict[str, Any]]:
    """The sections of a preset, or of a TOML file where `name` ends in .toml.

    Raises:
        UsageError: no such preset or file, or it is not TOML.
    """
    try:
        if name.endswith(".toml"):
            text = read_regular(Path(name), MAX_PRESET).decode("utf-8").replace("\r\n", "\n")
        else:
            if name not in presets():
                raise UsageError(f"no preset {name[:40]!r}: {did_you_mean(name, presets())}")
            text = resources.files("cdmisfa.presets").joinpath(f"{name}.toml").read_text("utf-8")
        document = copy.deepcopy(_parsed(text))
    except ValueError as error:
        raise UsageError(f"{name}: not TOML: {error}") from error
    except RecursionError:
        raise UsageError(f"{name}: not a preset: it is nested too deep") from None
    for key, value in document.items():
        if not isinstance(value, dict):
            raise UsageError(f"{name}: {shown(key)} stands outside a [section]")
    return document


@lru_cache
def _parsed(text: str) -> dict[str, Any]:
    """A TOML document; once parsed it is known to every trial of a sweep."""
    return tomllib.loads(text)


def shown(value: Any) -> str:
    """A value as an error shows it: a text as it is, others as Python writes them, all short."""
    text = value if isinstance(value, str) else _SHORT.repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def build(
    cls: type[Section], prefix: str, *layers: Mapping[str, Any], base: Section | None = None
) -> Section:
    """Fill a section's dataclass from layers of values, the last one winning.

    Values may be of the field's type or text of it (as given to `--set`); nested
    dataclasses take tables or dotted names.

    Raises:
        UsageError: an unknown key (with the nearest valid one) or a value of the wrong type.
    """
    hints = _hints(cls)
    values: dict[str, Any] = {}
    nested: dict[str, list[Mapping[str, Any]]] = {}
    for layer in layers:
        for key, value in layer.items():
            name, dot, rest = key.partition(".")
            if name not in hints:
                hint = did_you_mean(name, hints, f"{prefix}.")
                raise UsageError(f"unknown key {prefix}.{shown(key)}: {hint}")
            if dataclasses.is_dataclass(hints[name]):
                if not dot and not isinstance(value, Mapping):
                    raise UsageError(f"{prefix}.{name} is a table: set one of its keys")
                nested.setdefault(name, []).append({rest: value} if dot else value)
            elif dot:
                raise UsageError(
                    f"unknown key {prefix}.{shown(key)}: {prefix}.{name} has no keys of its own"
                )
            else:
                values[name] = convert_value(value, hints[name], f"{prefix}.{name}")
    for name, parts in nested.items():
        values[name] = build(
            hints[name], f"{prefix}.{name}", *parts, base=getattr(base or cls(), name)
        )
    return dataclasses.replace(base, **values) if base else cls(**values)  # type: ignore[type-var]


def convert_value(value: Any, hint: Any, key: str) -> Any:
    """A value, or its text, as the type of a field.

    Raises:
        UsageError: the value does not fit.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        if value in arguments:
            return value
        choices = ", ".join(str(a) for a in arguments)
        raise UsageError(f"{key} is {shown(value)}: choose one of {choices}")
    if origin is types.UnionType or origin is typing.Union:
        if value is None or value == "auto" or (value == "none" and str not in arguments):
            return None
        try:
            return convert_value(value, next(a for a in arguments if a is not types.NoneType), key)
        except UsageError as error:
            raise UsageError(f"{error}, or auto") from None
    if origin is tuple:
        parts = value.strip("()[] ").split(",") if isinstance(value, str) else value
        if not isinstance(parts, list | tuple):
            raise UsageError(f"{key} is {shown(value)}: it must be a list")
        if isinstance(value, str):
            parts = [part.strip() for part in parts if part.strip()]
        inner = arguments if arguments[-1] is not Ellipsis else (arguments[0],) * len(parts)
        if len(inner) != len(parts):
            raise UsageError(f"{key} is {shown(value)}: it must have {len(inner)} values")
        return tuple(convert_value(p, h, key) for p, h in zip(parts, inner, strict=True))
    if hint not in _SCALARS:
        raise TypeError(f"{key}: fields of type {hint} cannot be configured")
    words, scalar = _SCALARS[hint]
    try:
        return scalar(value)
    except (ValueError, TypeError, KeyError, OverflowError):
        raise UsageError(f"{key} is {_SHORT.repr(value)}: it must be {words}") from None


def _boolean(value: Any) -> bool:
    if isinstance(value, bool):
        return value
    return {"true": True, "false": False}[value.lower() if isinstance(value, str) else ""]


def _whole(value: Any) -> int:
    number = int(value) if isinstance(value, str) else index(value)
    if isinstance(value, bool) or abs(number) > LARGEST:
        raise ValueError
    return number


def _number(value: Any) -> float:
    number = float(value)
    if isinstance(value, bool) or math.isnan(number):
        raise ValueError
    return number


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    raise TypeError


_SCALARS: Mapping[Any, tuple[str, Callable[[Any], Any]]] = {
    bool: ("true or false", _boolean),
    int: ("a whole number", _whole),
    float: ("a number", _number),
    str: ("a text", _text),
}
"""For each type of a key: its words in errors, and its conversion from a value or text."""


def section_table(section: Any) -> dict[str, Any]:
    """A section as plain JSON values, nested sections as tables, `None` as "auto"."""
    table: dict[str, Any] = {}
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if field.metadata.get("unsaid") and value == field.default:
            continue  # recordings of scenes without it stay the same bytes
        if dataclasses.is_dataclass(value):
            table[field.name] = section_table(value)
        else:
            plain = list(value) if isinstance(value, tuple) else value
            table[field.name] = "auto" if value is None else plain
    return table


def parse_settings(words: Iterable[str]) -> dict[str, dict[str, str]]:
    """Turn `section.key=value` words into sections of texts.

    Raises:
        UsageError: a word of another form.
    """
    sections: dict[str, dict[str, str]] = {}
    for word in words:
        key, equals, value = word.partition("=")
        section, dot, name = key.strip().partition(".")
        if not (equals and section and dot and name):
            raise UsageError(
                f"--set {shown(word)}: write it as section.key=value, as learner.nu=0.02"
            )
        sections.setdefault(section, {})[name] = value.strip()
    return sections
