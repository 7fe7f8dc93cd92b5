"""Configuration: frozen dataclasses, filled from TOML presets and `--set` words.

Each package defines the dataclass of its own section: `learner` here and in `agents.progress`,
`record` and `scene` in `recorder`, `input` in `recorder.images`. `key` declares the type, the
default and the range of a key in one place. `build` fills a section; for an unknown key it raises
an error with the nearest name.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import reprlib
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from operator import index
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

from cdmisfa.core.errors import UsageError, did_you_mean
from cdmisfa.core.untrusted import read_regular

T = TypeVar("T")


# Largest number of whitened components; more would take minutes a frame.
MAX_COMPONENTS = 1000

# Largest number of frames in a block; more do not fit into memory beside their images.
MAX_TAU = 100_000

# Largest preset in bytes: parsing time grows with the square of the number of dots in a key.
MAX_PRESET = 16 * 1024

# Characters of a value or key in an error; longer ones are cut.
MAX_TEXT = 120

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 3
_SHORT.maxtuple = _SHORT.maxlist = _SHORT.maxdict = 8
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = MAX_TEXT


def key(
    default: Any,
    low: float | str = -math.inf,
    high: float | str = math.inf,
    *,
    above: bool = False,
    rising: bool = False,
    unstated: bool = False,
) -> Any:
    """Declare a key of a section.

    Args:
        default: the default value.
        low: smallest value, or the name of the key that holds it; for a tuple, of each number.
        high: largest value, in the same way. Infinity is always refused.
        above: True if the value must be above `low`.
        rising: True if the numbers of a tuple must not fall.
        unstated: True if `section_table` leaves out the default, so that recordings of scenes that
            are older than the key keep their bytes.
    """
    rule = {"low": low, "high": high, "above": above, "rising": rising, "unstated": unstated}
    return dataclasses.field(default=default, metadata=rule)


@dataclass(frozen=True, slots=True)
class Section:
    """Section of the configuration: every value has the type of its key and is in its range."""

    prefix: ClassVar[str] = ""

    @classmethod
    def key_name(cls, name: str) -> str:
        """Return the name of a key as users write it."""
        return f"{cls.prefix}.{name}"

    def __post_init__(self) -> None:
        """Convert and check all values.

        Raises:
            UsageError: a value does not fit; the message names the key.
        """
        hints, fields = _hints(type(self)), dataclasses.fields(self)
        for field in fields:
            value = getattr(self, field.name)
            value = convert_value(value, hints[field.name], self.key_name(field.name))
            object.__setattr__(self, field.name, value)
        for field in fields:
            if field.metadata and (expected := self._misfit(field.name, field.metadata)):
                value = _SHORT.repr(getattr(self, field.name))
                raise UsageError(f"{self.key_name(field.name)} is {value}: it must be {expected}")

    def _misfit(self, name: str, rule: Mapping[str, Any]) -> str:
        """Return the values that are allowed, or "" if the present value is."""
        low, high = (
            getattr(self, rule[bound]) if isinstance(rule[bound], str) else rule[bound]
            for bound in ("low", "high")
        )
        value = getattr(self, name)
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if rule["rising"] and list(numbers) != sorted(numbers):
            return "two numbers, the smaller first"
        if (low, high) == (-math.inf, math.inf):
            return ""
        for number in numbers:
            enough = low < number if rule["above"] else low <= number
            if not (enough and number <= high and number < math.inf):
                first, last = "(" if rule["above"] else "[", "]" if high < math.inf else ")"
                return f"in {first}{low:g}, {high:g}{last}"
        return ""


@dataclass(frozen=True, slots=True)
class LearnerConfig(Section):
    """Configuration of the paper's learners, CD-MISFA 2.0 and 1.0 (keys `learner.*`).

    The defaults are those of the oscillatory experiment. The presets name the origin of each value.

    Attributes:
        algorithm: `2.0`, or `1.0` for the older algorithm that the paper compares with.
        nu: ν, learning rate of the slow features. A larger value learns faster and is noisier.
        tau: τ, block length in frames. The learner chooses the next stream after each block.
        sigma: σ, width of the expert reward: a change of the weights φ below this counts as
            mastered. 0 switches the expert reward off.
        delta: δ, a module is saved when its slowness changes by less than this in a block
            (1/frame).
        beta: β, weight of the expert reward. `auto` is ν ln 2 / (2 (n-1)) for n streams.
        components: K, number of principal components that are whitened. 6 to 10 work for the
            iCub images; it must not exceed the number of independent inputs.
        outputs: J, number of slow features of a module.
        expansion: `none`, or `quadratic` to add all products of two inputs.
        epsilon_start: ε at the start: the probability of a random action. Above 1 counts as 1.
        epsilon_decay: factor by which ε shrinks in each iteration while it is above
            `epsilon_knee`.
        epsilon_knee: value of ε below which `epsilon_tail_decay` applies.
        epsilon_tail_decay: factor by which ε shrinks in each iteration below `epsilon_knee`.
        gamma: γ, discount of future rewards.
        mean_window: window of the running mean of the input (frames).
        slowness_window: N, window of the mean squared derivative and of the variance of an output
            (frames).
        eta_dot_window: w, window of the change of slowness and of `novel_share` (blocks).
        gate_window: w_g, window of the mean and standard deviation of a module's slowness
            (blocks).
        warm_up: number of novel blocks before a new feature earns rewards.
        min_variance: v_min, smallest variance of an output with which a module is saved. It
            excludes outputs that are constant, and so look perfectly slow.
        novel_share: smallest share of recent blocks that were novel and of the same stream as the
            block before, with which a module is saved.
        patience: number of iterations without exploration and without a new module after which
            the run ends.
        alpha: α, learning rate of the reward table (1.0 only).
        roc_centres: number of cluster centres for each stream (1.0 only).
        roc_radius: distance within which an output moves a cluster centre (1.0 only).
        roc_memory: number of blocks over which a cluster centre is forgotten (1.0 only).
        roc_error: clustering error below which a module is saved, or explains a block (1.0 only).
    """

    prefix: ClassVar[str] = "learner"
    algorithm: str = "2.0"
    nu: float = key(0.05, 0, 1, above=True)
    tau: int = key(100, 3, MAX_TAU)
    sigma: float = key(0.0009, 0)
    delta: float = key(0.0006, 0, above=True)
    beta: float | None = key(None, 0)
    components: int = key(5, 1, MAX_COMPONENTS)
    outputs: int = key(1, 1, "components")
    expansion: str = "quadratic"
    epsilon_start: float = key(1.2, 0, above=True)
    epsilon_decay: float = key(0.999, 0, 1)
    epsilon_knee: float = key(0.8, 0)
    epsilon_tail_decay: float = key(0.95, 0, 1)
    gamma: float = key(0.99, 0, 0.999999)
    mean_window: int = key(1000, 1)
    slowness_window: int = key(600, 1)
    eta_dot_window: int = key(40, 1)
    gate_window: int = key(20, 1)
    warm_up: int = key(80, 0)
    min_variance: float = key(0.1, 0)
    novel_share: float = key(0.9, 0, 1)
    patience: int = key(1000, 1)
    alpha: float = key(0.005, 1e-6, 1)
    roc_centres: int = key(10, 1)
    roc_radius: float = key(0.3, 0, above=True)
    roc_memory: int = key(40, 1)
    roc_error: float = key(0.1, 0)

    def reward_beta(self, n_streams: int) -> float:
        """Return the weight of the expert reward: `beta`, or the paper's nu ln 2 / (2 (n-1)).

        Source: paper, Hyper Parameters.
        """
        if self.beta is not None:
            return self.beta
        return self.nu * math.log(2) / (2.0 * max(n_streams - 1, 1))


_hints: Any = cache(typing.get_type_hints)


def presets() -> tuple[str, ...]:
    """Return the names of the presets in the package."""
    folder = resources.files("cdmisfa.presets")
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml")))


def load_preset(name: str) -> dict[str, dict[str, Any]]:
    """Return the sections of a preset, or of a TOML file if `name` ends in .toml.

    Raises:
        UsageError: the preset or file does not exist, or is not TOML.
    """
    if name.endswith(".toml"):
        data = read_regular(Path(name), MAX_PRESET)
    elif name in presets():
        data = resources.files("cdmisfa.presets").joinpath(f"{name}.toml").read_bytes()
    else:
        raise UsageError(f"no preset {name[:40]!r}: {did_you_mean(name, presets())}")
    try:
        document = tomllib.loads(data.decode("utf-8").replace("\r\n", "\n"))
        for section, table in document.items():
            if not isinstance(table, dict):
                raise ValueError(f"{short_text(section)} is outside of any [section]")
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{name}: not a preset, which is a TOML file: {error}") from None
    return document


def short_text(value: Any) -> str:
    """Return a value for an error: a text as it is, others as in Python, all shortened."""
    text = value if isinstance(value, str) else _SHORT.repr(value)
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}..."


def parse_settings(words: Iterable[str]) -> dict[str, dict[str, str]]:
    """Parse `section.key=value` words into sections.

    Raises:
        UsageError: a word has another form.
    """
    sections: dict[str, dict[str, str]] = {}
    for word in words:
        path, equals, value = word.partition("=")
        section, dot, name = path.strip().partition(".")
        if not (equals and section and dot and name):
            raise UsageError(f"--set {short_text(word)}: write section.key=value (learner.nu=0.02)")
        sections.setdefault(section, {})[name] = value.strip()
    return sections


def build(cls: type[T], prefix: str, *layers: Mapping[str, Any], base: T | None = None) -> T:
    """Fill a section's dataclass from layers of values; later layers override earlier ones.

    A value has the key's type or is a text of it, as given to `--set`. The values of nested
    dataclasses are tables or have dotted names.

    Raises:
        UsageError: a key is unknown, or a value does not fit.
    """
    hints = _hints(cls)
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    nested: dict[str, list[Mapping[str, Any]]] = {}
    for layer in layers:
        for path, value in layer.items():
            name, dot, rest = path.partition(".")
            table = name in names and dataclasses.is_dataclass(hints[name])
            if name not in names or (dot and not table):
                hint = did_you_mean(name, names, f"{prefix}.")
                raise UsageError(f"unknown key {prefix}.{short_text(path)}: {hint}")
            if table:
                nested.setdefault(name, []).append({rest: value} if dot else value)
            else:
                values[name] = convert_value(value, hints[name], f"{prefix}.{name}")
    for name, parts in nested.items():
        if not all(isinstance(part, Mapping) for part in parts):
            raise UsageError(f"{prefix}.{name} is not a value but a table: set one of its keys")
        inner = getattr(base or cls(), name)
        values[name] = build(hints[name], f"{prefix}.{name}", *parts, base=inner)
    return dataclasses.replace(base, **values) if base else cls(**values)  # type: ignore[type-var]


def convert_value(value: Any, hint: Any, key: str) -> Any:
    """Return a value, or the value of a text, in the type of a key.

    Raises:
        UsageError: the value does not fit.
    """
    try:
        return _converted(value, hint)
    except (ValueError, TypeError, KeyError, OverflowError):
        text = _SHORT.repr(value)
        raise UsageError(f"{key} is {text}: it must be {_words_of(hint)}") from None


def _converted(value: Any, hint: Any) -> Any:
    kind, arguments = typing.get_origin(hint), typing.get_args(hint)
    if kind is Literal:
        return arguments[arguments.index(value)]
    if kind in (types.UnionType, typing.Union):
        if types.NoneType in arguments and (
            value in (None, "auto") or (value == "none" and str not in arguments)
        ):
            return None
        for argument in arguments:
            with contextlib.suppress(ValueError, TypeError, KeyError):
                return _converted(value, argument)  # no value converts to NoneType
        raise ValueError
    if kind is tuple:
        parts = value
        if isinstance(value, str):
            parts = [part.strip() for part in value.strip("()[] ").split(",") if part.strip()]
        if not isinstance(parts, list | tuple):
            raise TypeError
        inner = (arguments[0],) * len(parts) if arguments[-1] is Ellipsis else arguments
        return tuple(_converted(part, h) for part, h in zip(parts, inner, strict=True))
    if dataclasses.is_dataclass(hint):
        return value
    return _SCALARS[hint][1](value)


def _words_of(hint: Any) -> str:
    """Return a description of the values of a type, for an error."""
    kind, arguments = typing.get_origin(hint), typing.get_args(hint)
    if kind is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if kind in (types.UnionType, typing.Union):
        words = ["auto" if a is types.NoneType else _words_of(a) for a in arguments]
        return " or ".join(words)
    if kind is tuple:
        many = "each" if arguments[-1] is Ellipsis else f"{len(arguments)} values, each"
        return f"a list, {many} {_words_of(arguments[0])}"
    return _SCALARS[hint][0]


def _whole(value: Any) -> int:
    number = int(value) if isinstance(value, str) else index(value)
    if isinstance(value, bool) or abs(number) >= 2**63:  # signed integers of 64 bits
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


# For each type of a key: its description in errors, and the conversion from a value or text.
_SCALARS: Mapping[Any, tuple[str, Callable[[Any], Any]]] = {
    bool: ("true or false", lambda value: {"true": True, "false": False}[str(value).lower()]),
    int: ("a whole number", _whole),
    float: ("a number", _number),
    str: ("a text", _text),
}


def section_table(section: Any) -> dict[str, Any]:
    """Return a section as plain JSON values, nested sections as tables, `None` as "auto"."""
    table: dict[str, Any] = {}
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if field.metadata.get("unstated") and value == field.default:
            continue
        if dataclasses.is_dataclass(value):
            table[field.name] = section_table(value)
        else:
            plain = list(value) if isinstance(value, tuple) else value
            table[field.name] = "auto" if value is None else plain
    return table
