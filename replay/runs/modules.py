"""The frozen modules of a run: modules.npz as plain arrays, and scikit-learn style transformers.

Neither the learner nor scikit-learn is needed to use what was learned.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import LogDamagedError, UsageError, one_line
from cdmisfa.modules import Module
from recorder.images.framing import Recipe
from recorder.log.files import atomic_write
from replay.runs.folders import MODULES_FILE
from replay.storage.arrays import read_arrays

_NAME = re.compile(r"module([1-9]\d{0,8})_([a-z_]+)")
_FIELDS = [field.name for field in dataclasses.fields(Module)]
_SCALARS = {
    **dict.fromkeys(("index", "stream_index", "iteration"), "iu"),
    "stream": "U",
    "expansion": "U",
    "recipe": "U",
    "scale": "f",
}
"""Fields that are no arrays, and the kind of numpy type that each is stored as."""


def save_modules(path: Path, modules: Iterable[Module]) -> None:
    """Write modules as arrays `module<index>_<field>`, whole or not at all.

    Raises:
        LogWriteError: the file cannot be written.
    """
    arrays: dict[str, Any] = {}
    for module in modules:
        for name in _FIELDS:
            arrays[_key(module.index, name)] = getattr(module, name)
        recipe = "" if module.recipe is None else json.dumps(module.recipe.as_json())
        arrays[_key(module.index, "recipe")] = recipe
    with atomic_write(Path(path)) as partial, open(partial, "wb") as file:
        np.savez(file, **arrays)


def load_modules(path: Path) -> tuple[Module, ...]:
    """The modules of a file, or of a run's folder, in the order of learning.

    Raises:
        UsageError: there is no such file.
        LogDamagedError: it holds something else.
    """
    path = Path(path)
    path = path / MODULES_FILE if path.is_dir() else path
    try:
        stored = read_arrays(path)
        return tuple(_module(stored, index) for index in _indices(stored))
    except FileNotFoundError as error:
        raise UsageError(f"{path} does not exist: name a run's folder") from error
    except (OSError, ValueError, KeyError, TypeError, OverflowError, SystemError) as error:
        raise LogDamagedError(f"{path} holds no modules ({one_line(error)})") from error


def _module(stored: Mapping[str, NDArray[Any]], index: int) -> Module:
    values: dict[str, Any] = {}
    for name in _FIELDS:
        array, kinds = stored[_key(index, name)], _SCALARS.get(name, "fi")
        if array.dtype.kind not in kinds:
            raise ValueError(f"{name} is not of type {kinds}")
        values[name] = array.item() if name in _SCALARS else array
    values["frame_shape"] = tuple(map(int, values["frame_shape"].tolist()))
    values["recipe"] = Recipe.from_json(values["recipe"]) if values["recipe"] else None
    outputs, size = values["phi"].shape
    shapes = {"mean": size, "band_mean": outputs, "band_sd": outputs, "eta": outputs}
    for name, length in shapes.items():
        if values[name].shape != (length,):
            raise ValueError(f"{name} has shape {values[name].shape}")
    return Module(**values)


def _indices(stored: Mapping[str, NDArray[Any]]) -> list[int]:
    """The modules' indices, of a file in which every name is that of a module's field.

    A checksum protects the arrays' values, but nothing protects their names and number.
    """
    fields: dict[int, set[str]] = {}
    for name in stored:
        found = _NAME.fullmatch(name)
        if found is None:
            raise ValueError(f"{name[:40]!r} is nothing of a module")
        fields.setdefault(int(found[1]), set()).add(found[2])
    indices = sorted(fields)
    if indices != list(range(1, len(indices) + 1)):
        raise ValueError(f"there are modules {indices}, one is missing")
    for found_fields in fields.values():
        if other := sorted(found_fields.symmetric_difference(_FIELDS)):
            raise ValueError(f"{other[0][:40]!r} is missing, or nothing of a module")
    if any(int(stored[_key(index, "index")]) != index for index in indices):
        raise ValueError("the numbers of modules are mixed up")
    return indices


def _key(index: int, name: str) -> str:
    return f"module{index}_{name}"


class SlowFeatures:
    """Slow features of frames, as a frozen module gives them.

    It comes fitted. In a pipeline that is to be fitted as a whole, put it into
    scikit-learn's `FrozenEstimator`.

    Args:
        module: the frozen module.

    Example:
        >>> rest = [np.zeros(1)] * 3 + [np.zeros(1, np.int64)]
        >>> module = Module(1, "x1", 0, 9, np.eye(1, 2), np.zeros(2), *rest, scale=1.0)
        >>> SlowFeatures(module).transform([[3.0, 4.0], [5.0, 6.0]]).ravel().tolist()
        [3.0, 5.0]
    """

    def __init__(self, module: Module) -> None:
        self.module = module

    @classmethod
    def load(cls, path: str | Path) -> tuple[Self, ...]:
        """A transformer for each module of modules.npz, or of a run's folder, in order.

        Raises:
            UsageError: there is no such file.
            LogDamagedError: it holds something else.
        """
        return tuple(cls(module) for module in load_modules(Path(path)))

    def __repr__(self) -> str:
        return f"SlowFeatures({self.module!r})"

    def _repr_html_(self) -> str:
        return self.module._repr_html_()

    @property
    def components_(self) -> FloatArray:
        """(J, I) weights, a row an output."""
        return self.module.phi

    @property
    def mean_(self) -> FloatArray:
        """(I,) mean of the input, after scaling and expansion."""
        return self.module.mean

    def transform(self, X: Any) -> FloatArray:
        """Outputs of the module on frames, y = phi (x - mean).

        Args:
            X: (n, *frame_shape), the shape of a frame that it learned from, or these as rows
                (n, I); uint8 count 1/255 each where it learned from pixels. They are expanded as
                they were for the learner.

        Returns:
            (n, J).

        Raises:
            UsageError: these are no frames as the module learned from.
        """
        return self.module.transform(X)

    def fit(self, X: Any = None, y: Any = None) -> NoReturn:
        """Refuse: a frozen module does not learn.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            "a frozen module is not fitted again: learn a new one with cdmisfa learn, or put this "
            "one into sklearn.frozen.FrozenEstimator to keep it as it is in a pipeline"
        )

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Its parameters, as scikit-learn asks for them."""
        return {"module": self.module}

    def set_params(self, **params: Any) -> Self:
        """Change what it was made with.

        Raises:
            UsageError: there is no such parameter.
        """
        if unknown := set(params) - {"module"}:
            raise UsageError(f"no parameter {', '.join(sorted(unknown))}: there is module")
        self.module = params.get("module", self.module)
        return self

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import Tags, TargetTags, TransformerTags

        return Tags(
            estimator_type=None,
            target_tags=TargetTags(required=False),
            transformer_tags=TransformerTags(),
            requires_fit=False,
        )
