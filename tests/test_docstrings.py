"""Every example in a docstring gives what it says."""

from __future__ import annotations

import doctest
import importlib

import pytest
from sources import files, name

WITH_EXAMPLES = [
    name(file).removesuffix(".py").replace("/", ".")
    for file in files()
    if ">>> " in file.read_text("utf-8")
]


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_give_what_they_say(module: str) -> None:
    if module == "cdmisfa.watching":
        pytest.importorskip("gymnasium")
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0
