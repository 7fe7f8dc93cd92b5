"""The frozen modules of a run, stored as plain arrays in modules.npz."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError, UsageError, one_line
from cdmisfa.core.expansion import EXPANSIONS, expanded_size
from cdmisfa.modules import PRINCIPAL, SLOW, Module
from recorder.images.framing import Recipe
from recorder.log.files import atomic_write
from replay.runs.folders import MODULES_FILE
from replay.storage.arrays import read_arrays

_FIELDS = [field.name for field in dataclasses.fields(Module)]

# Kinds of numpy type that fields may be stored as; all but the last are scalars.
_TYPES = {
    **dict.fromkeys(("index", "stream_index", "iteration"), "iu"),
    "stream": "U",
    "expansion": "U",
    "recipe": "U",
    "scale": "f",
    "kinds": "U",
}
_SCALARS = _TYPES.keys() - {"kinds"}


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
    """Read the modules of a file or of a run's folder, in the order of learning.

    Raises:
        UsageError: the file does not exist.
        LogDamagedError: the file is damaged or holds no modules.
    """
    path = Path(path)
    path = path / MODULES_FILE if path.is_dir() else path
    try:
        return tuple(_modules(read_arrays(path)))
    except FileNotFoundError as error:
        raise UsageError(f"{path} does not exist: name the folder of a run") from error
    except (OSError, ValueError, KeyError, TypeError, OverflowError, SystemError) as error:
        raise LogDamagedError(f"{path} is not a file of modules ({one_line(error)})") from error


def _modules(stored: Mapping[str, NDArray[Any]]) -> Iterator[Module]:
    """Yield the modules of a file; a checksum protects its arrays, but not their names."""
    # Files written before modules had principal components have no kinds: all outputs are slow.
    names = [name for name in _FIELDS if name != "kinds" or _key(1, name) in stored]
    indices = range(1, len(stored) // len(names) + 1)
    if stored.keys() != {_key(index, name) for index in indices for name in names}:
        raise ValueError(f"its arrays are not those of modules 1 to {len(indices)}")
    for index in indices:
        values: dict[str, Any] = {}
        for name in names:
            array, kinds = stored[_key(index, name)], _TYPES.get(name, "fi")
            if array.dtype.kind not in kinds:
                raise ValueError(f"{name} is not of type {kinds}")
            values[name] = array.item() if name in _SCALARS else array
        if values["index"] != index:
            raise ValueError(f"module {index} has number {values['index']}")
        values["frame_shape"] = tuple(map(int, values["frame_shape"].tolist()))
        values["recipe"] = Recipe.from_json(values["recipe"]) if values["recipe"] else None
        yield checked(Module(**values))


def checked(module: Module) -> Module:
    """Return a module from a file after checking its values.

    Raises:
        ValueError: a value is not finite, out of range, or of a shape or type that does not fit.
    """
    J, size = np.shape(module.phi)
    streams, shape = np.shape(module.policy), module.frame_shape
    fitting: dict[str, tuple[Any, ...]] = dict.fromkeys(("eta", "band_mean", "band_sd"), ((J,),))
    fitting |= {"phi": ((J, size),), "mean": ((size,),), "slow": ((0,), (J,)), "scale": ((),)}
    fitting |= {"policy": (streams[:1],), "counts": (np.shape(module.centres)[:2],)}
    for name, shapes in fitting.items():
        array = np.asarray(getattr(module, name))
        if array.shape not in shapes or array.dtype.kind not in "fi":
            raise ValueError(f"{name} has shape {array.shape} and type {array.dtype}")
        if name in ("phi", "mean", "scale") and not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    if not (J and size and streams and min(module.stream_index, module.iteration) >= 0):
        raise ValueError(f"module {module.index} has no outputs, or a negative number")
    if len(module.kinds) != J or not {SLOW, PRINCIPAL}.issuperset(module.kinds):
        raise ValueError(f"outputs are of the kinds {module.kinds}")
    known = bool(shape) and module.expansion in EXPANSIONS  # others can be used once registered
    if min(shape, default=1) < 1 or (
        known and expanded_size(module.expansion, prod(shape)) != size
    ):
        raise ValueError(f"{size} weights do not fit frames of shape {shape}")
    return module


def _key(index: int, name: str) -> str:
    return f"module{index}_{name}"
