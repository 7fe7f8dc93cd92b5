"""What the command line refuses: one line that says what is wrong, and nothing is written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Cdmisfa
from folders import contents
from test_cli import assert_one_line

LOGS = Path(__file__).parents[1] / "sample_logs" / "icub"

A_RUN = "is a run, not a recording: open it with cdmisfa view"
NO_MCAP = "numbers.h5 is not a supported log: logs are .mcap, .bag and .db3 files"
VAIN = "is for live scenes, and this source is not one"
TAKEN = "taken exists: choose another folder"

CASES: dict[str, tuple[str, ...]] = {
    # words: what the line says. RUN, REC and LOGS are a run, a recording, and logs.
    "learn no/such.mcap": ("no/such.mcap", "icub and oscillatory"),
    **{f"{command} no/such": ("no/such",) for command in ("info", "verify", "view")},
    "compare no/such neither": ("no/such",),
    "export no/such -o x.csv": ("no/such: no such file or folder",),
    "learn oscillatory --set learner.nuu=1": ("did you mean learner.nu?",),
    "learn oscillatory --set lerner.nu=1": ("did you mean learner?",),
    "learn oscillatory --set learner.nu=x": ("learner.nu", "number"),
    "learn oscillatory --set nu": ("section.key=value",),
    "learn oscillatory --preset icubs": ("did you mean icub?",),
    "learn": ("SOURCE", "cdmisfa learn --help"),
    "record icub": ("-o",),
    # options that would do nothing
    "learn oscillatory --loop --skip-damaged": (
        "is no log: --loop and --skip-damaged are for logs",
    ),
    "record gym:Pendulum-v1 -o x --view a": ("is a live stream: --view is for scenes",),
    "convert LOGS --set learner.nu=1 -o x": ("--set takes keys input.* here, not learner.*",),
    "view RUN --topic /a --save v.rrd": ("is a run: --topic is for logs",),
    "learn REC --set scene.seed=9": ("scene.seed " + VAIN,),
    "sweep REC --grid scene.seed=9,10 -o sweep": ("scene.seed " + VAIN,),
    "learn oscillatory --resume -o RUN --algorithm progress": (
        "was made with learner.algorithm = 2.0, not progress",
    ),
    # what is written has the name of its kind
    "view RUN --save x.mp4": ("x.mp4: a view is a Rerun file: name it x.rrd",),
    "export REC --to images -o z.csv": ("z.csv: the output is a folder: name it without .csv",),
    # a file of another kind is a wrong word and no damage
    **{f"{command} numbers.h5": (NO_MCAP,) for command in ("info", "verify", "check")},
    "view --save out.rrd numbers.h5": (NO_MCAP,),
    "recover numbers.csv -o out.mcap": ("numbers.csv is not an MCAP file", "--skip-damaged"),
    "learn RUN": (A_RUN,),
    # results are not written to URLs, and a secret in one is not printed
    "learn oscillatory -o s3://lab/x": ("s3://lab/x is a URL: name a path on this machine",),
    "record rtsp://user:secret@[::1 -o x --frames 1": ("rtsp://[::1 cannot be opened",),
    # a grid is checked before anything runs, and live streams are recorded first
    "sweep oscillatory --seeds 0 -o s --grid learner.tau=40,many": ("learner.tau",),
    "sweep gym:Pendulum-v1 --seeds 0 -o s": (
        "record it first with cdmisfa record gym:Pendulum-v1 -o REC",
    ),
    # --summary prints the results of a sweep, and computes nothing
    "sweep oscillatory": ("name the folder of the sweep with -o",),
    "sweep oscillatory --csv -o s": ("--csv needs --summary",),
    "sweep taken --summary -o s": ("--summary only prints results: leave out -o",),
    "sweep taken --summary --seeds 0": ("--summary only prints results: leave out --seeds",),
    "sweep taken RUN --summary": ("--summary takes the folder of one sweep",),
    "sweep taken --summary --csv --json": ("choose one of --csv and --json",),
    "sweep taken --summary": ("taken is not a sweep",),
    # an error names the largest value of an option
    "learn oscillatory --seed 9223372036854775808": ("from 0 to 9223372036854775807",),
    "convert left.mcap --rate 1e7 -o x": ("from 0.001 to 1000000",),
    "doctor left.mcap": ("check files with cdmisfa verify left.mcap",),
    # a fork that cannot be
    "fork RUN --iteration 3 -o x --set learner.tau=20": ("learner.tau cannot change in a fork",),
    "fork RUN --iteration 16 -o x": ("has 15 iterations",),
    # neither a file nor the folder one is in is replaced
    "fork RUN --iteration 3 --force -o file": ("file is a file: name a folder",),
    "learn oscillatory -o EMPTY": ("is empty: name a",),
    # resuming is advised only where it can be
    "learn oscillatory -o taken": (TAKEN, "continue with --resume"),
    "fork RUN --iteration 3 -o taken": (TAKEN,),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder that a command runs in, which it leaves as it is."""
    monkeypatch.chdir(tmp_path)
    Path("numbers.h5").write_bytes(b"PK" + bytes(100))
    Path("numbers.csv").write_text("a,b\n" + "1,2\n" * 200)
    Path("file").write_bytes(b"kept")
    Path("taken").mkdir()
    Path("taken/there").touch()
    before = contents(tmp_path)
    yield tmp_path
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("case", CASES)
def test_it_is_refused_in_one_line(
    cdmisfa: Cdmisfa, oscillatory_run: Path, oscillatory_recording: Path, case: str
) -> None:
    places = {"RUN": oscillatory_run, "REC": oscillatory_recording, "LOGS": LOGS, "EMPTY": ""}
    words = case
    said = list(CASES[case])
    for name, place in places.items():
        words = " ".join(
            word.replace(name, str(place), 1) if word.split("/")[0] == name else word
            for word in words.split(" ")
        )
        said = [line.replace(f"and {name} ", f"and {place} ") for line in said]
    before = contents(oscillatory_run)
    done = cdmisfa(*words.split(" "))
    assert_one_line(done, 2, *said)
    assert "--resume" in "".join(said) or "continue with --resume" not in done.err
    assert contents(oscillatory_run) == before
