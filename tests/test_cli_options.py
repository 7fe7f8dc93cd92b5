"""Options of commands, help pages, shell completion, -q, and suggestions of similar names."""

from __future__ import annotations

import re
import shlex
from dataclasses import fields
from pathlib import Path

import click
import pytest
from conftest import Cdmisfa
from interface import command_of
from waiting import python

from cdmisfa.cli import options
from cdmisfa.cli.app import COMMANDS, cli
from cdmisfa.cli.commands.learn import learn_command
from cdmisfa.experiments.run_folder import words_of
from recorder.images.options import OPTIONS, InputConfig, InputOptions


def options_of(name: str) -> list[click.Option]:
    return [p for p in command_of(name).params if isinstance(p, click.Option) and not p.hidden]


def test_options_stay_few() -> None:
    assert sum(len(options_of(name)) for name in COMMANDS) <= 182
    assert len(options_of("learn")) <= 26


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_and_option_has_a_help_text(name: str) -> None:
    command = command_of(name)
    assert command.name == name
    for text in (command.help, cli.help):
        assert len((text or "").partition("\n")[0].split()) <= 12
    for option in options_of(name):
        assert (option.help or "").endswith((".", "]")), option.name


def test_the_root_help_fits_on_one_screen(cdmisfa: Cdmisfa) -> None:
    lines = cdmisfa("--help").out.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_with_three_examples_that_the_command_takes(cdmisfa: Cdmisfa, name: str) -> None:
    text = cdmisfa(name, "--help").out
    assert max(map(len, text.splitlines())) <= 80
    examples = text.partition("\nExamples:\n")[2].splitlines()
    assert len(examples) == 3
    assert examples[0].startswith(f"  cdmisfa {name}")
    for example in examples:
        program, other, *words = shlex.split(example)
        command = command_of(other)
        context = click.Context(command)
        values, rest, _ = command.make_parser(context).parse_args(words)
        assert (program, rest) == ("cdmisfa", [])
        for param in command.params:
            value = values.get(param.name or "")
            assert isinstance(value, str | list | tuple) or not param.required, example
            if isinstance(value, str | list):
                param.type_cast_value(context, value)


def test_help_needs_no_docstrings() -> None:
    done = python("-OO", "-m", "cdmisfa", "learn", "--help")
    assert (done.returncode, done.stderr, "--seed N" in done.stdout) == (0, "", True)


def test_help_says_what_each_argument_may_be(cdmisfa: Cdmisfa) -> None:
    for name in COMMANDS:
        text = cdmisfa(name, "--help").out
        for param in command_of(name).params:
            if isinstance(param, click.Argument) and name != "doctor":
                argument = param.make_metavar(click.Context(cli)).strip("[].")
                assert re.search(rf"^  {argument} is( one of)?:$", text, re.M), (name, argument)


def test_every_setting_of_inputs_is_an_option_or_a_key() -> None:
    keys = [field.name for field in fields(InputConfig)]
    assert [field.name for field in fields(InputOptions)] == [*keys, *OPTIONS, "native"]
    assert {
        name: param.opts for param in options_of("learn") if (name := param.name) in OPTIONS
    } == {name: [option] for name, option in OPTIONS.items()}


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
    # `native` is set by exports alone.
    assert len(chosen.chosen()) == len(fields(chosen)) - 1
    parsed: list[InputOptions] = []

    @click.command()
    @options.inputs(*options.ALL_INPUTS, "settings")
    def command(inputs: InputOptions) -> None:
        parsed.append(inputs)

    stated = {name: getattr(chosen, name) for name in OPTIONS}
    words = words_of({**stated, "settings": tuple(chosen.settings())})
    command.main(words, standalone_mode=False)
    command.main([], standalone_mode=False)
    assert parsed == [chosen, InputOptions()]


def test_a_shell_completes_commands_options_choices_and_files(
    cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch
) -> None:
    def completed(line: str) -> list[str | None]:
        monkeypatch.setenv("COMP_WORDS", f"cdmisfa {line}")
        monkeypatch.setenv("COMP_CWORD", str(len(line.split(" "))))
        monkeypatch.setenv("_CDMISFA_COMPLETE", "bash_complete")
        pairs = [result.split(",", 1) for result in cdmisfa().out.splitlines()]
        return [value if kind == "plain" else None for kind, value in pairs]

    assert completed("") == COMMANDS
    assert completed("lea") == ["learn"]
    assert completed("learn x --max-mod") == ["--max-modules"]
    for command in ("learn", "convert", "view", "info", "check", "apply"):
        assert completed(f"{command} x") == [None]


LEARN = ("learn", "oscillatory", "--max-iterations", "500", "--max-modules", "1")


def test_quiet_is_quiet_before_and_after_the_command(cdmisfa: Cdmisfa) -> None:
    loud = cdmisfa(*LEARN, "--json")
    assert "module 1 saved" in loud.err
    for words in (("-q", *LEARN, "--json"), (*LEARN, "--json", "--quiet")):
        quiet = cdmisfa(*words)
        assert (quiet.code, quiet.err, quiet.json) == (0, "", loud.json)
    refused = cdmisfa("-q", "info", "no/such")
    assert (refused.code, refused.err) == (2, "cdmisfa: no/such: no such file or folder\n")
    assert "module 1 saved" in cdmisfa(*LEARN).err  # -q is of one command


def test_an_unexpected_error_is_one_line_that_says_where(
    cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*words: object, **how: object) -> None:
        raise RuntimeError("odd")

    monkeypatch.setattr(learn_command, "callback", broken)
    assert re.fullmatch(
        r"cdmisfa: unexpected RuntimeError at \w+\.py:\d+: odd \(please report it\)\n",
        cdmisfa(*LEARN).err,
    )


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("learn oscilatory", "oscillatory"),
        ("learn ICUB", "icub"),
        ("learn camra:/dev/video0", "camera:/dev/video0"),
        ("learn oscillatory --algorithm progres", "progress"),
        ("info rec/leff.mcap", "rec/left.mcap"),
        ("view rec/rum", "rec/run"),
        ("export rec/run --to parqet -o x.y", "parquet"),
        ("lern x", "learn"),
    ],
)
def test_a_similar_name_is_suggested(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, meant: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec" / "run").mkdir(parents=True)
    (tmp_path / "rec" / "left.mcap").touch()
    done = cdmisfa(*words.split())
    assert (done.code, f"did you mean {meant}" in done.err) == (2, True)
