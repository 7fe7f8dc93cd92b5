"""Incremental slow feature analysis."""

from cdmisfa.incsfa.abstraction import IncSFA
from cdmisfa.incsfa.projection import project
from cdmisfa.incsfa.state import Params, State, copy_into, new_state, parameters

__all__ = ["IncSFA", "Params", "State", "copy_into", "new_state", "parameters", "project"]
