"""Options are made of the fields of dataclasses, and --help lists them in groups."""

from __future__ import annotations

import dataclasses
from typing import Any

import click
import pytest
from conftest import Cdmisfa

from cdmisfa.cli.app import COMMANDS, cli
from cdmisfa.cli.making import GROUPS, GroupedCommand, Option
from cdmisfa.core.errors import UsageError
from cdmisfa.core.options import given, option_name, option_words
from recorder.cameras.options import LiveOptions
from recorder.images.options import ImageOptions
from replay.camera_logs.options import CameraOptions

MADE = {
    "record": (ImageOptions, LiveOptions),
    "convert": (CameraOptions, LiveOptions),
    "learn": (CameraOptions, LiveOptions),
    "sweep": (CameraOptions,),
}
"""Commands with all options of these dataclasses."""


def options_of(name: str) -> dict[str, click.Option]:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    return {
        word: param
        for param in command.params
        if isinstance(param, click.Option)
        for word in (*param.opts, *param.secondary_opts)
    }


@pytest.mark.parametrize("name", MADE)
def test_every_setting_has_its_option_and_no_option_is_without(name: str) -> None:
    options, made = options_of(name), set()
    for settings in MADE[name]:
        for field in (field for field in dataclasses.fields(settings) if field.metadata):
            option = options[option_name(field)]
            assert option.name == field.name
            assert option.help == field.metadata["about"]
            assert option.get_default(click.Context(cli)) == field.default or (
                option.multiple and field.default == ()
            )
            made.add(option_name(field))
    grouped = {
        word
        for word, option in options.items()
        if isinstance(option, Option) and option.group in ("Images", "Live streams")
    }
    assert grouped - made <= {"--record"}


@pytest.mark.parametrize("settings", [ImageOptions, CameraOptions, LiveOptions])
def test_every_field_is_an_option_but_the_seed_that_all_share(settings: Any) -> None:
    plain = [field.name for field in dataclasses.fields(settings) if not field.metadata]
    assert plain in ([], ["seed"])


def test_the_words_of_settings_are_read_as_these_settings() -> None:
    chosen = CameraOptions(
        topics=("/a", "/b*"),
        size=(48, 64),
        fit="pad",
        rate=12.5,
        color=True,
        depth=(-0.5, 3.0),
        fields=("x", "y[0:3]"),
        time="t:ns",
        stamp="header",
        start=1.5,
        stop=90.0,
        gaps="hold",
        align="time",
    )
    assert len(given(chosen)) == len(dataclasses.fields(chosen))
    told: list[CameraOptions] = []

    from cdmisfa.cli.options import log_options

    @click.command()
    @log_options
    def command(cameras: CameraOptions) -> None:
        told.append(cameras)

    command.main(option_words(chosen), standalone_mode=False)
    command.main([], standalone_mode=False)
    assert told == [chosen, CameraOptions()]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_each_option_once_the_common_six_first(cdmisfa: Cdmisfa, name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    lines = cdmisfa(name, "--help").out.splitlines()
    listed = [line.split()[0].rstrip(",") for line in lines if line.startswith("  -")]
    shown = [p for p in options_of(name).values() if not p.hidden]
    assert sorted(listed) == sorted([*{p.opts[0] for p in shown}, "-h"])
    headings = [line[:-1] for line in lines if line.endswith(":") and not line.startswith(" ")]
    if isinstance(command, GroupedCommand):
        assert headings == ["Most used", *(group for group in GROUPS if group in headings)]
        assert len(headings) > 2
        assert all(not line or line.startswith("  ") for line in lines[2:] if line[-1:] != ":")
    else:
        assert headings == ["Options"]
    assert isinstance(command, GroupedCommand) or name not in ("learn", "record", "view")


@pytest.mark.parametrize(
    ("chosen", "why"),
    [
        ({"rate": float("nan")}, r"--rate is nan: it must be in \[0.001, 1000000\]"),
        ({"rate": -5.0}, "--rate is -5.0"),
        ({"rate": 1e12}, "--rate is 1e12|--rate is 1000000000000.0"),
        ({"rate": "25"}, "--rate is 25"),
        ({"size": (0, 4)}, r"--size is \(0, 4\): give height and width above 0"),
        ({"size": "x"}, "--size is x"),
        ({"start": float("nan")}, "--from is nan: give seconds from 0 on"),
        ({"stop": "late"}, "--to is late"),
    ],
)
def test_settings_of_a_log_or_a_caller_are_checked_like_typed_ones(
    chosen: dict[str, Any], why: str
) -> None:
    with pytest.raises(UsageError, match=f"^({why})"):
        CameraOptions(**chosen)


@pytest.mark.parametrize(
    "words",
    [
        ("convert", "a.mcap", "--rate", "nan"),
    ],
)
def test_no_number_is_no_number(cdmisfa: Cdmisfa, words: tuple[str, ...]) -> None:
    done = cdmisfa(*words)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert f"{words[-2]}': nan is no finite number" in done.err
