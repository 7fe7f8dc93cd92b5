"""Options of commands, and the settings that external logs are read with."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import click
import pytest
from conftest import Cdmisfa

from cdmisfa.cli.app import COMMANDS, cli
from cdmisfa.cli.options import INPUTS, input_options
from cdmisfa.core.errors import UsageError
from recorder.images.options import OPTIONS, InputConfig, InputOptions


def options_of(name: str) -> list[click.Option]:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    return [p for p in command.params if isinstance(p, click.Option) and not p.hidden]


def test_options_stay_few() -> None:
    assert sum(len(options_of(name)) for name in COMMANDS) <= 180
    assert len(options_of("learn")) <= 25


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_and_option_has_a_help_text(name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert (command.name, (command.help or "").partition("\n")[0][-1]) == (name, ".")
    for option in options_of(name):
        assert option.help, option.name
        assert option.help.rstrip(")").endswith((".", "]")), option.help


def test_every_setting_of_inputs_is_an_option_or_a_key() -> None:
    keys = [field.name for field in fields(InputConfig)]
    assert [field.name for field in fields(InputOptions)] == [*keys, *OPTIONS]
    assert {
        name: param.opts for param in options_of("learn") if (name := param.name) in OPTIONS
    } == {name: [option] for name, option in OPTIONS.items()}
    assert INPUTS.keys() == OPTIONS.keys()


def test_the_words_of_settings_are_read_as_these_settings() -> None:
    chosen = InputOptions(
        topics=("/a", "/b*"),
        size=(48, 64),
        fit="pad",
        rate=12.5,
        color=True,
        range=(-0.5, 3.0),
        fields=("x", "y[0:3]"),
        time="t:ns",
        stamp="header",
        start=1.5,
        end=90.0,
        gaps="hold",
        align="time",
        centre="episode",
        holdout=0.2,
        hold=1.0,
        lost="end",
        stall=9.0,
    )
    assert len(chosen.chosen()) == len(fields(chosen))
    told: list[InputOptions] = []

    @click.command()
    @input_options(keys=True)
    def command(inputs: InputOptions) -> None:
        told.append(inputs)

    command.main(chosen.words(), standalone_mode=False)
    command.main([], standalone_mode=False)
    assert told == [chosen, InputOptions()]


@pytest.mark.parametrize(
    ("chosen", "why"),
    [
        ({"rate": float("nan")}, "--rate is nan: it must be a number"),
        ({"rate": -5.0}, "--rate is -5.0"),
        ({"rate": 1e12}, "--rate is 1e12|--rate is 1000000000000.0"),
        ({"rate": []}, r"--rate is \[\]"),
        ({"size": (0, 4)}, r"--size is \(0, 4\): it must be in \[1, inf\)"),
        ({"size": "x"}, "--size is 'x'"),
        ({"start": float("inf")}, "--start is inf"),
        ({"end": "late"}, "--end is 'late'"),
        ({"range": (5, -5)}, r"input.range is \(5.0, -5.0\)"),
        ({"holdout": 0.95}, r"input.holdout is 0.95: it must be in \[0, 0.9\]"),
        ({"color": "red"}, "--color is 'red'"),
    ],
)
def test_settings_of_a_log_or_a_caller_are_checked_like_typed_ones(
    chosen: dict[str, Any], why: str
) -> None:
    with pytest.raises(UsageError, match=f"^({why})"):
        InputOptions(**chosen)


def test_no_number_is_no_number(cdmisfa: Cdmisfa) -> None:
    done = cdmisfa("convert", "a.mcap", "-o", "rec", "--rate", "nan")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "--rate is nan: it must be a number" in done.err
