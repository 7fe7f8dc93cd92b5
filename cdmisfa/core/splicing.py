"""Functions written into the compiled ones that call them, as if their text stood there.

Numba can do so, but copies every argument first. For a tuple of many arrays that is counting
many references, in every turn of a loop.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from numba.core import compiler, compiler_machinery, ir, ir_utils, untyped_passes


class _DropCopies(compiler_machinery.FunctionPass):
    """Use a function's arguments themselves where a spliced function has copies of them."""

    _name = "drop_copies"

    def __init__(self) -> None:
        """Nothing to keep."""

    def run_pass(self, state: Any) -> bool:
        """Change the function's statements in place."""
        blocks: Any = state.func_ir.blocks
        assigned = [s for block in blocks.values() for s in block.find_insts(ir.Assign)]
        times = Counter(s.target.name for s in assigned)
        once = [s for s in assigned if times[s.target.name] == 1]
        arguments = {s.target.name for s in once if isinstance(s.value, ir.Arg)}
        copies = [s for s in once if isinstance(s.value, ir.Var) and s.value.name in arguments]
        for block in blocks.values():
            block.body = [s for s in block.body if s not in copies]
        _replace_vars(blocks, {s.target.name: s.value for s in copies})
        return True


_register: Any = compiler_machinery.register_pass
_replace_vars: Any = ir_utils.replace_vars
_builder: Any = compiler.DefaultPassBuilder
_register(mutates_CFG=False, analysis_only=False)(_DropCopies)


class Splicing(compiler.CompilerBase):
    """Numba's compiler, with no copies of what spliced functions are handed."""

    def define_pipelines(self) -> list[Any]:
        """Numba's passes and one more."""
        passes = _builder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_DropCopies, untyped_passes.InlineInlinables)
        passes.finalize()
        return [passes]
