"""Machine code that the compiler made, run without the compiler: its import takes .3 s.

What is loaded of numba is what its compiled code calls: four small modules written in C. Where
anything is not as expected here, callers have the compiler do what it would have done.
"""

from __future__ import annotations

import builtins
import ctypes
import importlib
import importlib.util
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.machinery import PathFinder
from pathlib import Path
from threading import Lock
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple, cast

_NUMBERS = [f"{kind}{bits}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64)]
_NUMBERS += ["complex64", "complex128", "boolean"]

LOADING = Lock()
"""Held while a package stands in for numba's, which nobody may import meanwhile."""


@dataclass(frozen=True)
class MachineCode:
    """A compiled function for arguments of certain types.

    Attributes:
        name: of the function.
        code: the object file.
        entry: symbol of what Python calls.
        environments: names of its environments, and the constants in each.
        needs: symbols that others define.
    """

    name: str
    code: bytes
    entry: str
    environments: dict[str, list[Any]]
    needs: tuple[str, ...]


def machine_code(result: Any) -> MachineCode | None:
    """What the compiler made, or None where that is more than code and constants."""
    library, function = result.library, result.fndesc
    if result.reload_init or result.objectmode:
        return None
    known = (*result._find_referenced_environments(), result.environment)
    parts = (library._final_module.functions, library._final_module.global_variables)
    return MachineCode(
        name=function.qualname,
        code=library._get_compiled_object(),
        entry=function.llvm_cpython_wrapper_name,
        environments={one.env_name: list(one.consts) for one in known},
        needs=tuple(
            one.name
            for part in parts
            for one in part
            if one.is_declaration and not one.name.startswith("llvm.")
        ),
    )


def loaded(machine: MachineCode, module: str) -> Callable[..., Any]:
    """A function of a module, from what was made of it.

    Raises:
        Exception: it cannot run here.
    """
    import llvmlite.binding as llvm

    with LOADING:
        runtime = _runtime()
        missing = [name for name in machine.needs if not llvm.address_of_symbol(name)]
        if missing:
            raise LookupError(f"no {missing[0]}")
        engine = runtime.engine
        engine.add_object_file(llvm.ObjectFileRef.from_data(machine.code))
        engine.finalize_object()
        environments = []
        for name, constants in machine.environments.items():
            environments.append(environment := runtime.functions.Environment({"__name__": module}))
            environment.consts[:] = constants
            if place := engine.get_global_value_address(name):
                ctypes.c_void_p.from_address(place).value = id(environment)
        address = engine.get_function_address(machine.entry)
        if not address:
            raise LookupError(f"no {machine.entry}")
        made: Callable[..., Any] = runtime.functions.make_function(
            sys.modules[module],
            machine.name.rpartition(".")[2],
            f"machine code of {machine.name}",
            address,
            environments[-1],
            tuple(environments),
        )
        return made


def fingerprint() -> Callable[[tuple[Any, ...]], bytes]:
    """What tells arguments of different types apart, as the compiler does at every call."""
    with LOADING:
        found: Callable[[tuple[Any, ...]], bytes] = _runtime().types.compute_fingerprint
    return found


class _Runtime(NamedTuple):
    functions: Any
    types: Any
    engine: Any


@cache
def _runtime() -> _Runtime:
    """What machine code needs around it."""
    import llvmlite.binding as llvm

    with _package("numba") as folder:
        types = importlib.import_module("numba._dispatcher")
        functions = importlib.import_module("numba._dynfunc")
        helpers = importlib.import_module("numba._helperlib")
        memory = _module("numba.core.runtime._nrt_python", folder)
        _have_read_by(_constant, helpers.c_helpers["unpickle"])
    if "numba.core.dispatcher" not in sys.modules:  # it does this again with its own numbers
        types.typeof_init(object, dict.fromkeys(_NUMBERS, 0))
    symbols = {"_Py_NoneStruct": id(None)}
    for name, address in {**helpers.c_helpers, **functions.c_helpers}.items():
        symbols[f"numba_{name}"] = address
    for name, address in memory.c_helpers.items():
        symbols[name if name.startswith("_") else f"NRT_{name}"] = address
    for value in vars(builtins).values():
        if isinstance(value, type) and issubclass(value, BaseException):
            symbols[f"PyExc_{value.__name__}"] = id(value)
    for name, address in symbols.items():
        llvm.add_symbol(name, address)
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine()
    empty = llvm.parse_assembly(f'target triple = "{llvm.get_process_triple()}"')
    return _Runtime(functions, types, llvm.create_mcjit_compiler(empty, machine))


def _constant(address: int, pickled: bytes, hashed: bytes) -> Any:
    """What machine code holds pickled: the class of every array it returns, for one."""
    key = address, hashed
    if key not in _CONSTANTS:
        _CONSTANTS[key] = pickle.loads(pickled)
    return _CONSTANTS[key]


_CONSTANTS: dict[tuple[int, bytes], Any] = {}


def _have_read_by(read: Callable[..., Any], unpickle: int) -> None:
    """Have numba's helper read constants with this, where it would import the compiler to do so.

    It looks for a function of this name the first time that it is called.
    """
    name = "numba.core.serialize"
    if name not in sys.modules:
        sys.modules[name] = cast(ModuleType, SimpleNamespace(_numba_unpickle=read))
        helper = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p)
        nothing = pickle.dumps(None)
        try:
            helper(unpickle)(nothing, len(nothing), bytes(64))
        finally:
            del sys.modules[name]


@contextmanager
def _package(name: str) -> Iterator[Path]:
    """A package whose modules can be imported, without what its `__init__` imports."""
    if name in sys.modules:
        importlib.import_module(name)  # which waits where another thread has only begun to
        found = None
    else:
        found = importlib.util.find_spec(name)
    if found is not None:
        sys.modules[name] = importlib.util.module_from_spec(found)
    try:
        yield Path(str(sys.modules[name].__file__)).parent
    finally:
        if found is not None:
            del sys.modules[name]


def _module(name: str, folder: Path) -> ModuleType:
    """A module of the package in this folder, without the packages between."""
    if name not in sys.modules:
        rooms = name.split(".")[1:-1]
        spec = PathFinder.find_spec(name, [str(folder.joinpath(*rooms))])
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]
