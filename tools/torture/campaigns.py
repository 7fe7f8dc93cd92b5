"""The campaigns, and the modules they are."""

from __future__ import annotations

import importlib
from types import ModuleType

CAMPAIGNS = (
    "kills",
    "children",
    "follows",
    "power",
    "failing",
    "disks",
    "descriptors",
    "races",
    "damage",
    "servers",
    "histories",
)
"""Modules of this folder, in the order of the page."""


def campaign(name: str) -> ModuleType:
    """The module of a campaign."""
    return importlib.import_module(f"{__package__}.{name}")
