"""What the command line refuses: one line that says what is wrong, and nothing is written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import Cdmisfa
from folders import contents
from test_cli import assert_one_line

LOGS = Path(__file__).parents[1] / "sample_logs" / "icub"

A_RUN = "is a run, not a recording: look at it with cdmisfa view"
NO_MCAP = "numbers.h5 is no log that is read: logs are .mcap, .bag and .db3 files"
ONE = "oscillatory is a scene: name it alone"
VAIN = "is for live scenes, and this source is none"
SIZED = "oscillatory is a scene: --size and --rate are for logs and cameras; its rate is --set rec"
FOLDER = "file is a file: name a folder"
TAKEN = "taken exists: choose another folder"

CASES: dict[str, tuple[str, ...]] = {
    # words: what the line says. RUN, REC and LOGS are a run, a recording, and logs.
    "learn no/such.mcap": ("no/such.mcap", "icub, oscillatory"),
    "learn oscilatory": ("oscilatory", "did you mean oscillatory?"),
    "record icubs -o x": ("icubs", "did you mean icub?"),
    "record icub": ("-o",),
    "record oscillatory -o x --view x9": ("x9", "x1, x2, x3"),
    **{f"{command} no/such": ("no/such",) for command in ("info", "verify", "view")},
    "compare no/such neither": ("no/such",),
    "export no/such -o x.csv": ("no/such: no such file or folder",),
    "learn oscillatory --set learner.nuu=1": ("did you mean learner.nu?",),
    "learn oscillatory --set lerner.nu=1": ("did you mean learner?",),
    "learn oscillatory --set learner.nu=x": ("learner.nu", "number"),
    "learn oscillatory --set nu": ("section.key=value",),
    "learn oscillatory --set scene.kind=icub": ("scene.kind",),
    "learn oscillatory --preset icubs": ("did you mean icub?",),
    "record oscillatory -o x --set scene.eyes.width=9": ("unknown key scene.eyes.width",),
    "learn oscillatory --preset no.toml": ("no.toml",),
    "learn": ("SOURCE", "cdmisfa learn --help"),
    "learn oscillatory --sead 1": ("--seed",),
    "learn oscillatory --resume": ("-o",),
    "learnn": ("did you mean learn?",),
    "view x --web --save y.rrd": ("--save",),
    # options that would do nothing, and values that are none
    "record oscillatory -o x --set input.hold=3": (
        "oscillatory is a scene: input.hold is for logs",
    ),
    "convert LOGS --set learner.nu=1 -o x": ("--set takes keys input.* here, not learner.*",),
    "view RUN --topic /a --save v.rrd": ("is a run: --topic is for logs",),
    "sweep oscillatory -o x --seeds 1,4,0:2": ("--seeds 1,4,0:2: write each seed once",),
    "learn oscillatory --set learner.beta=foo": ("'foo': it must be a number or auto",),
    "record oscillatory -o x --rate abc": ("'abc' is not a valid float",),
    "learn oscillatory --resume -o RUN --algorithm progress": (
        "was made with learner.algorithm = 2.0, not progress",
    ),
    # what is written has the name of its kind
    "view RUN --save x.mp4": ("x.mp4: the view is a file of Rerun, name it x.rrd",),
    "view RUN --screenshot x.rrd": ("x.rrd: the screenshot is a PNG, name it x.png",),
    "compare RUN RUN --save x.png": ("x.png: the view is a file of Rerun, name it x.rrd",),
    "export REC --to images -o z.csv": ("z.csv: a folder is written, name it without .csv",),
    "recover REC/x1.mcap -o x.csv": ("x.csv: the log is an MCAP file, name it x.mcap",),
    **{
        f"{words} -o x.mcap": ("x.mcap: a folder is written, name it without .mcap",)
        for words in ("record oscillatory", "learn oscillatory", "convert LOGS", "sweep REC")
    },
    "view x --at 3 --save x.rrd": ("--at goes with a window",),
    # a scene is one, and has no options of cameras
    "learn oscillatory icub": (ONE,),
    **{f"{c} oscillatory -o o --size 8x8 --rate 9": (SIZED,) for c in ("learn", "record", "sweep")},
    # what only a live scene can be told; the manifest would state it, whatever was recorded
    "learn REC --set scene.seed=9": ("scene.seed " + VAIN,),
    "learn numbers.csv --rate 10 --set record.fps=9": ("record.fps " + VAIN,),
    "sweep REC --grid scene.seed=9,10 -o sweep": ("scene.seed " + VAIN,),
    # a file of another kind is a wrong word and no damage
    **{f"{command} numbers.h5": (NO_MCAP,) for command in ("info", "verify")},
    "check numbers.h5": (NO_MCAP,),
    "recover -o out.mcap numbers.h5": (NO_MCAP,),
    "view --save out.rrd numbers.h5": (NO_MCAP,),
    "export --to images -o out numbers.h5": (NO_MCAP,),
    **{
        f"{command} arrays.npz": ("arrays.npz holds arrays: make a recording", "cdmisfa convert")
        for command in ("check",)
    },
    "recover -o out.mcap arrays.npz": ("arrays.npz is no MCAP file",),
    **{
        f"recover {name} -o out.mcap": (
            f"{name} is no MCAP file, and others are not recovered",
            "--salvage",
        )
        for name in ("numbers.csv", "pictures")
    },
    # results are not written to URLs
    **{
        f"{words} s3://lab/x": ("s3://lab/x is a URL: name a path on this machine",)
        for words in ("learn oscillatory -o", "recover RUN/run.mcap -o", "view RUN --save")
    },
    # a run is no recording
    **{f"learn {run}": (A_RUN,) for run in ("RUN", "RUN/run.mcap")},
    # options that are written otherwise
    "learn nothing.mcap --size 0x48": ("--size",),
    "learn nothing.mcap --start 1:2:3:4": ("--start",),
    "learn nothing.mcap --set input.range=3,1": ("input.range",),
    "learn nothing.mcap --set input.fit=cut": ("input.fit is 'cut': it must be one of crop",),
    # a grid is checked before anything runs, and live streams are recorded first
    "sweep oscillatory --seeds 0 -o s --grid learner.sigm=1": ("did you mean learner.sigma",),
    "sweep oscillatory --seeds 0 -o s --grid learner.tau=40,many": ("learner.tau",),
    "sweep LOGS --seeds 0 -o s --grid input.fit=pad,crop": ("input.fit is the same for all",),
    "sweep gym:Pendulum-v1 --seeds 0 -o s": (
        "record it first, with cdmisfa record gym:Pendulum-v1 -o REC",
    ),
    # a fork that cannot be
    "fork RUN --iteration 3 -o x --set learner.tau=20": ("learner.tau stays as in the parent",),
    "fork RUN --iteration 3 -o x --set scene.seed=3": ("scene.* stays as in the parent",),
    "fork RUN --iteration 16 -o x": ("holds 15 iterations",),
    # experiments that there are not, or not so
    "reproduce stabillity -o x": ("no experiment 'stabillity': did you mean stability?",),
    # what is read from no URL, and what is the URL of no log
    "results https://host/a/b": ("https://host/a/b is a URL: name a path on this machine",),
    "info gs://bucket/a.mcap": ("s3, http, https",),
    "info https://host": ("names no file",),
    "record rtsp://user:secret@[::1 -o x --frames 1": ("rtsp://[::1 cannot be opened",),
    # a file is not taken for a folder
    "learn oscillatory --force -o file/below": (FOLDER,),
    "record oscillatory --resume -o file/below": (FOLDER,),
    "fork RUN --iteration 3 --force -o file": (FOLDER,),
    # no name is not the folder one is in
    "learn oscillatory -o EMPTY": ("is empty: name a",),
    "view RUN --save EMPTY": ("is empty: name a",),
    **{f"{command} EMPTY": ("is empty: name a",) for command in ("learn", "view", "info")},
    # resuming is advised only where it can be
    "learn oscillatory -o taken": (TAKEN, "go on with --resume"),
    "record oscillatory -o taken": (TAKEN, "go on with --resume"),
    "fork RUN --iteration 3 -o taken": (TAKEN,),
    "record gym:Pendulum-v1 -o taken": (TAKEN,),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder that a command runs in, which it leaves as it is."""
    monkeypatch.chdir(tmp_path)
    Path("numbers.h5").write_bytes(b"PK" + bytes(100))
    np.savez("arrays.npz", a=np.zeros(9))
    Path("numbers.csv").write_text("a,b\n" + "1,2\n" * 200)
    Path("file").write_bytes(b"kept")
    for name in ("pictures/0.png", "taken/there"):
        Path(name).parent.mkdir()
        Path(name).touch()
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
    kept = contents(oscillatory_run)
    done = cdmisfa(*words.split(" "))
    assert_one_line(done, 2, *said)
    assert "--resume" in "".join(said) or "go on with --resume" not in done.err
    assert contents(oscillatory_run) == kept
