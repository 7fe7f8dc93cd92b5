"""Signals: they end what a command does, once, wherever they come."""

from __future__ import annotations

import signal
import time
from typing import Any

import click
import pytest

from cdmisfa.cli.app import run
from cdmisfa.cli.interrupts import SIGNALS, interruptible, stoppable


def wait() -> None:
    """Long enough for anything that comes again."""
    time.sleep(5)


class Late:
    """Gets a signal when it is let go of, where Python passes no exception on."""

    def __init__(self, number: signal.Signals) -> None:
        self._number = number

    def __del__(self) -> None:
        signal.raise_signal(self._number)


@pytest.mark.parametrize("number", SIGNALS)
def test_an_interrupt_that_a_destructor_drops_comes_again(number: signal.Signals) -> None:
    with interruptible() as stop:
        Late(number)
        with pytest.raises(KeyboardInterrupt):
            wait()
    assert stop.exit_code == 128 + number


def test_the_second_signal_interrupts_although_a_destructor_drops_it(capfd: Any) -> None:
    with interruptible() as outer, stoppable() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop()
        Late(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            wait()
    assert outer.exit_code == 130
    assert capfd.readouterr().err == "stopping after this iteration; again to stop at once\n"


def test_what_else_a_destructor_raises_is_told(capsys: Any, monkeypatch: Any) -> None:
    told: list[Any] = []
    monkeypatch.setattr("sys.unraisablehook", told.append)

    class Broken:
        def __del__(self) -> None:
            raise ValueError("broken")

    with interruptible():
        Broken()
    assert [what.exc_type for what in told] == [ValueError]


def test_a_line_that_is_told_at_the_end_is_told_whole(monkeypatch: Any, capsys: Any) -> None:
    echo = click.echo

    def interrupted(*args: Any, **options: Any) -> None:
        for number in SIGNALS:
            signal.raise_signal(number)
        echo(*args, **options)

    monkeypatch.setattr(click, "echo", interrupted)
    assert run(["info", "not/there"]) == 2
    assert capsys.readouterr().err.startswith("cdmisfa: not/there")
