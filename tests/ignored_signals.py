"""Signals that a run of the tests ignores, as under nohup, and what it begins must not."""

from __future__ import annotations

import signal


def let_children_be_signalled() -> None:
    """Have processes that are begun from now on take signals that this one goes on ignoring."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        if signal.getsignal(number) == signal.SIG_IGN:
            # what is ignored stays so in programs that a process begins; what is handled does not
            signal.signal(number, lambda number, frame: None)
