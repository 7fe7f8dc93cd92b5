"""Frozen modules at work: applied to a source, or to each of many logs."""

from cdmisfa.experiments.apply.application import Application
from cdmisfa.experiments.apply.writing import Totals, follow, written_to

__all__ = ["Application", "Totals", "follow", "written_to"]
