"""The campaigns, and the modules they are."""

from __future__ import annotations

import importlib
from types import ModuleType

CAMPAIGNS = {
    "kills": 2,
    "children": 0,
    "follows": 0,
    "power": 1,
    "failing": 0,
    "disks": 0,
    "descriptors": 0,
    "races": 2,
    "clocks": 0,
    "addresses": 6,
    "damage": 3,
    "bombs": 0,
    "histories": 1,
}
"""Modules of this folder, in the order of the page, with the faults they found that are mended."""


def campaign(name: str) -> ModuleType:
    """The module of a campaign."""
    return importlib.import_module(f"{__package__}.{name}")
