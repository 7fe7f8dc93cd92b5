"""Texts as the viewer can draw them.

The viewer ends at once, with everything in it, on a letter its font has not got.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache

import rerun as rr

from cdmisfa.core.signals import Signal

_DRAWN = (
    (0x20, 0x7E),  # ASCII
    (0xA1, 0x17F),  # Latin
    (0x300, 0x304),  # accents that are put over letters, as in η̇
    (0x306, 0x30C),
    (0x384, 0x3CE),  # Greek
    (0x400, 0x45F),  # Cyrillic
)
_LEFT_OUT = "⟨⟩"

SPELLED = ("y", "y_frozen", "eta", "eta_dot", "eta_inst", "eta_inst_frozen", "xi", "xi_dot")
"""Signals whose name is their symbol, spelled out."""


@lru_cache(maxsize=4096)
def label(text: str) -> str:
    """A text with what cannot be drawn left out or replaced by a question mark."""
    kept = (c for c in text if c not in _LEFT_OUT)
    return "".join(c if c == "\n" or _is_drawn(ord(c)) else "?" for c in kept)


def part(names: Sequence[str], index: int) -> str:
    """A stream's part of an entity's path: its number from 1, so that order holds, and its name."""
    return str(rr.escape_entity_path_part(f"{index + 1}_{label(names[index])}"))


def _is_drawn(code: int) -> bool:
    return any(low <= code <= high for low, high in _DRAWN)


def line_labels(signal: Signal, module: int, outputs: int) -> list[str]:
    """Names of a signal's lines: its symbol and unit, its module from 1, its outputs."""
    name = signal.name.replace("_", " ")
    symbol = signal.symbol.replace("_i", f"_{module}") if module else signal.symbol
    if signal.name in SPELLED or (not module and symbol == name):
        text = symbol
    else:
        text = f"{symbol} {name}{f' module {module}' if module else ''}".strip()
    unit = "" if signal.unit in ("", "1") else f" [{signal.unit}]"
    if "J" not in signal.dims or outputs == 1:
        return [f"{text}{unit}"]
    return [f"{text} output {j + 1}{unit}" for j in range(outputs)]


def text_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Lines of a table, and an empty one behind it."""
    lines = [head, ["---"] * len(head), *rows]
    return [*(f"| {' | '.join(map(str, line))} |" for line in lines), ""]
