"""Shell completion, help, -q, and error messages of the command line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from conftest import Cdmisfa

from cdmisfa.cli.app import COMMANDS
from cdmisfa.cli.commands.learn import learn_command


def completed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], line: str):
    """What bash is told to complete at the end of a line, files as None."""
    from cdmisfa.cli import run

    words = line.split(" ")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    monkeypatch.setenv("_CDMISFA_COMPLETE", "bash_complete")
    run([])
    pairs = [found.split(",", 1) for found in capsys.readouterr().out.splitlines()]
    return [value if kind == "plain" else None for kind, value in pairs]


def test_a_shell_completes_commands_options_choices_and_files(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def of(line: str) -> list[str | None]:
        return completed(monkeypatch, capsys, f"cdmisfa {line}")

    assert of("") == list(COMMANDS)
    assert of("lea") == ["learn"]
    assert of("learn x --max-mod") == ["--max-modules"]
    for command in ("learn", "convert", "view", "info", "check", "apply"):
        assert of(f"{command} x") == [None]


LEARN = ("learn", "oscillatory", "--max-iterations", "500", "--max-modules", "1")


def test_quiet_is_quiet_before_and_after_the_command(cdmisfa: Cdmisfa) -> None:
    said = cdmisfa(*LEARN, "--json")
    assert "module 1 saved" in said.err
    for words in (("-q", *LEARN, "--json"), (*LEARN, "--json", "--quiet")):
        quiet = cdmisfa(*words)
        assert (quiet.code, quiet.err, quiet.json) == (0, "", said.json)
    refused = cdmisfa("-q", "info", "no/such")
    assert (refused.code, refused.err) == (2, "cdmisfa: no/such: no such file or folder\n")
    assert "module 1 saved" in cdmisfa(*LEARN).err  # -q is of one command


def test_an_unexpected_error_is_one_line_that_says_where(
    cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*words: object, **how: object) -> None:
        raise RuntimeError("odd")

    monkeypatch.setattr(learn_command, "callback", broken)
    shown = cdmisfa(*LEARN).err
    assert re.fullmatch(
        r"cdmisfa: unexpected RuntimeError at test_completion\.py:\d+: odd \(please report it\)\n",
        shown,
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
def test_what_is_written_nearly_so_is_named(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, meant: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec" / "run").mkdir(parents=True)
    (tmp_path / "rec" / "left.mcap").touch()
    done = cdmisfa(*words.split())
    assert (done.code, f"did you mean {meant}" in done.err) == (2, True)
