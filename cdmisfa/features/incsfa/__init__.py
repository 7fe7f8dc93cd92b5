"""Incremental slow feature analysis."""

from cdmisfa.features.incsfa.abstraction import IncSFA
from cdmisfa.features.incsfa.projection import project
from cdmisfa.features.incsfa.state import Params, State, copy_into, new_state, parameters

__all__ = ["IncSFA", "Params", "State", "copy_into", "new_state", "parameters", "project"]
