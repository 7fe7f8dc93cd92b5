"""Rerun's viewer without a screen, for tests; they are skipped without a Vulkan driver."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from replay import viewer


def needs_driver(test: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a test that draws with Vulkan, and skip it where there is no driver."""
    skipped = pytest.mark.skipif(not viewer.vulkan_drivers(), reason=viewer.INSTALL)
    marked: Callable[..., Any] = pytest.mark.system(skipped(test))
    return marked


class Headless(viewer.Program):
    """A program of Rerun's that opens no window."""

    def __init__(self, *arguments: str) -> None:
        super().__init__("--headless", *arguments)


@contextlib.contextmanager
def shown(view: Path | str, size: str = "1200x800") -> Iterator[Callable[..., Any]]:
    """Show a view; yield a function that repeats a question to Rerun's client until it is true."""
    port = str(viewer.free_port())
    with Headless("--hide-welcome-screen", "--window-size", size, "--port", port, str(view)) as one:
        client = one.connect(port, None)
        yield lambda question: one.wait_for(lambda: question(client))
