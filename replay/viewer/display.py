"""What this machine has to show a window, or to draw a picture without one."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

INSTALL = "apt-get install mesa-vulkan-drivers libvulkan1"
"""What gives a machine without a graphics card a driver."""


def has_display() -> bool:
    """Whether a window can be opened."""
    return not sys.platform.startswith("linux") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def vulkan_drivers() -> Iterator[Path]:
    """Manifests of the Vulkan drivers that a loader would find."""
    chosen = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if chosen:
        yield from (p for p in map(Path, chosen.split(os.pathsep)) if p.exists())
        return
    shared = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    for folder in ("/etc", *shared.split(os.pathsep)):
        yield from Path(folder, "vulkan", "icd.d").glob("*.json")


def missing_driver() -> str:
    """Why no picture can be drawn without a screen here, or "" where it can."""
    if sys.platform.startswith("linux") and not any(vulkan_drivers()):
        return f"no Vulkan driver is installed: {INSTALL}"
    return ""
