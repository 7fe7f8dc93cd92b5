"""A bundle is checked by others as the run was learned; a changed or hostile one is refused."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from conftest import Cdmisfa
from PIL import Image
from test_same_bits import NO_FMA

from cdmisfa.public import crate

ROOT = Path(__file__).parents[1]
METADATA = crate.METADATA
SHORT = ("--max-iterations", 4, "--no-rerun", "--no-report")

Members = dict[str, bytes]


def members(bundle: Path) -> Members:
    with zipfile.ZipFile(bundle) as file:
        return {info.filename: file.read(info) for info in file.infolist()}


def graph(bundle: Path) -> dict[str, dict[str, object]]:
    return {unquote(e["@id"]): e for e in json.loads(members(bundle)[METADATA])["@graph"]}


def packed(path: Path, files: Members, compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, data in files.items():
            file.writestr(name, data)
    return path


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory, oscillatory_run: Path) -> Path:
    """Of a run on a recording; not to be changed."""
    from cdmisfa.cli import run

    path = tmp_path_factory.mktemp("bundles") / "run.zip"
    assert run(["bundle", str(oscillatory_run), "-o", str(path), "-q"]) == 0
    return path


def pictures(folder: Path, seed: int) -> Path:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for i in range(40):
        Image.fromarray(rng.integers(0, 256, (12, 16), np.uint8)).save(folder / f"é {i}.png")
    return folder


def test_a_bundle_is_checked_where_nothing_else_is(
    bundle: Path, tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_recording: Path
) -> None:
    copy = shutil.copy(bundle, tmp_path / "copy")  # whatever it is called
    oscillatory_recording.rename(oscillatory_recording.with_name("moved"))
    try:
        done, as_json = cdmisfa("check", copy), cdmisfa("check", copy, "--json")
    finally:
        oscillatory_recording.with_name("moved").rename(oscillatory_recording)
    assert (done.code, done.err) == (0, "")
    assert done.out == "iterations 0 to 14: learned again, they are identical, bit for bit\n"
    assert (as_json.json["run"], as_json.json["identical"]) == (str(copy), True)
    part = cdmisfa("check", copy, "--from", 3, "--to", 9, "--json").json
    assert (part["to"], part["identical"]) == (9, True)


@pytest.mark.skipif(shutil.which("qemu-x86_64") is None, reason="qemu-x86_64 is not installed")
def test_another_processor_says_the_same(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    run, bundle = tmp_path / "run", tmp_path / "run.zip"
    learned = ("--loop", "--max-iterations", 2, "--no-rerun", "--no-report")
    assert cdmisfa("learn", ROOT / "sample_logs" / "icub", *learned, "-o", run).code == 0
    assert cdmisfa("bundle", run, "-o", bundle).code == 0
    kept = {name: value for name, value in os.environ.items() if name != "OPENBLAS_CORETYPE"}
    looks = "from cdmisfa import kernels; print(kernels.WIDE);"
    code = f"{looks} from cdmisfa.cli import run; raise SystemExit(run(['check', {str(bundle)!r}]))"
    done = subprocess.run(
        ["qemu-x86_64", "-cpu", "Nehalem", sys.executable, "-c", code],
        env={**kept, **NO_FMA},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[0] == "False"
    assert "identical, bit for bit" in done.stdout


def test_the_same_run_gives_the_same_bytes(
    bundle: Path, tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_run: Path
) -> None:
    here = Path.cwd()
    os.chdir(oscillatory_run)
    try:
        assert cdmisfa("bundle", ".", "-o", tmp_path / "again.zip").code == 0
    finally:
        os.chdir(here)
    assert (tmp_path / "again.zip").read_bytes() == bundle.read_bytes()
    taken = cdmisfa("bundle", oscillatory_run, "-o", bundle)
    assert (taken.code, "overwrite with --force" in taken.err) == (2, True)


def test_it_is_described_for_others(
    bundle: Path, tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_run: Path
) -> None:
    found, files = graph(bundle), members(bundle)
    assert found[METADATA]["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    described = {name for name, entity in found.items() if entity["@type"] == "File"}
    assert described == files.keys() - {METADATA}
    assert {n for n in described if n.startswith("source/")} == {
        f"source/oscillatory/x{i}.mcap" for i in (1, 2, 3)
    }
    document = json.loads(files["run/run.json"])
    assert found["#cdmisfa"]["softwareVersion"] == document["versions"]["cdmisfa"]
    assert found["#learner.tau"]["value"] == document["config"]["learner"]["tau"]
    assert found["#learn"]["description"] == (
        "cdmisfa learn source/oscillatory/ --max-iterations 15 -o RUN"
    )
    refs = [
        ref
        for e in found.values()
        for v in e.values()
        for ref in (v if isinstance(v, list) else [v])
    ]
    named = {unquote(ref["@id"]) for ref in refs if isinstance(ref, dict)}
    assert named - found.keys() == {crate.CRATE}
    card = (ROOT / "CITATION.cff").read_text("utf-8")
    assert all(said in card for said in (crate.TITLE, crate.AUTHOR, crate.PAPER))
    told = ("--license", "CC-BY-4.0", "--author", "Ada", "--author", "Bo", "--date", "2026-01-31")
    out = tmp_path / "told.zip"
    assert (
        cdmisfa("bundle", oscillatory_run, "-o", out, *told, "--json").json["source"] == "included"
    )
    root = graph(out)["./"]
    assert (root["license"], root["datePublished"]) == (
        {"@id": "https://spdx.org/licenses/CC-BY-4.0"},
        "2026-01-31",
    )
    assert [ref["@id"] for ref in root["author"]] == ["#author/Ada", "#author/Bo"]  # type: ignore[attr-defined]
    wrong = cdmisfa("bundle", oscillatory_run, "-o", out, "--force", "--date", "today")
    assert (wrong.code, "no day" in wrong.err) == (2, True)


def test_folders_of_pictures_keep_their_names(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    cams = [pictures(tmp_path / side / "cam", seed) for seed, side in enumerate(("a", "b"))]
    told = ("--rate", 20, "--set", "learner.tau=10", "--holdout", 0)
    assert cdmisfa("learn", *cams, *told, *SHORT, "-o", tmp_path / "run").code == 0
    out = tmp_path / "f.zip"
    assert cdmisfa("bundle", tmp_path / "run", "-o", out).code == 0
    names = [name for name in members(out) if name.startswith("source/")]
    assert len(names) == 80
    assert "source/b/cam/é 3.png" in names
    (tmp_path / "elsewhere").mkdir()
    out.rename(tmp_path / "elsewhere" / "f.zip")
    for cam in cams:
        shutil.rmtree(cam)
    assert cdmisfa("check", tmp_path / "elsewhere" / "f.zip").code == 0


def test_logs_of_an_index_are_learned_again(
    tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_recording: Path
) -> None:
    logs, out = tmp_path / "logs", tmp_path / "f.zip"
    for name in ("a", "b"):
        shutil.copytree(oscillatory_recording, logs / name)
    assert cdmisfa("index", logs).code == 0
    assert cdmisfa("learn", logs, *SHORT, "-o", tmp_path / "run").code == 0
    assert cdmisfa("bundle", tmp_path / "run", "-o", out).code == 0
    shutil.rmtree(logs)
    done = cdmisfa("check", out)
    assert (done.code, done.err) == (0, "")


def test_a_scene_is_computed_with_what_its_preset_said(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    preset = tmp_path / "own.toml"
    preset.write_text('[scene]\nkind = "oscillatory"\nstreams = ["x2", "x1", "x3"]\n')
    told = ("--preset", preset, *SHORT, "--seed", 5)
    assert cdmisfa("learn", "oscillatory", *told, "-o", tmp_path / "run").code == 0
    preset.unlink()
    out = tmp_path / "f.zip"
    assert cdmisfa("bundle", tmp_path / "run", "-o", out, "--json").json["source"] == "scene"
    assert cdmisfa("check", out).code == 0
    assert "--preset own.toml" in str(graph(out)["#learn"]["description"])


def test_a_large_source_is_stated_by_its_hashes(
    tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_run: Path, oscillatory_recording: Path
) -> None:
    out = tmp_path / "small.zip"
    done = cdmisfa("bundle", oscillatory_run, "-o", out, "--no-source")
    assert (done.code, "names that with --source" in done.err) == (0, True)
    stated = graph(out)["#source/0/x1.mcap"]
    assert (
        stated["sha256"] == json.loads(members(out)["run/run.json"])["source"]["views"][0]["sha256"]
    )
    alone = cdmisfa("check", out)
    assert (alone.code, alone.err.count("\n"), "name it with --source" in alone.err) == (2, 1, True)
    assert cdmisfa("check", out, "--source", oscillatory_recording).code == 0


def test_what_cannot_be_checked_is_not_bundled(
    tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_recording: Path
) -> None:
    log, run, out = tmp_path / "log", tmp_path / "run", tmp_path / "f.zip"
    shutil.copytree(oscillatory_recording, log)
    assert cdmisfa("learn", log, *SHORT, "-o", run).code == 0
    assert cdmisfa("bundle", run, "-o", tmp_path / "f.tar").code == 2
    assert "x1.mcap is no run" in cdmisfa("bundle", log / "x1.mcap", "-o", out).err
    other = tmp_path / "other"
    assert cdmisfa("record", "oscillatory", "-o", other, "--frames", 2000, "--seed", 9).code == 0
    shutil.rmtree(log)
    other.rename(log)
    refused = cdmisfa("bundle", run, "-o", out)
    assert (refused.code, "no longer what" in refused.err, out.exists()) == (4, True, False)
    shutil.rmtree(log)
    refused = cdmisfa("bundle", run, "-o", out)
    assert (refused.code, "--source" in refused.err) == (2, True)
    data = (run / "run.mcap").read_bytes()
    (run / "run.mcap").write_bytes(data[:900] + b"?" + data[901:])
    assert cdmisfa("bundle", run, "-o", out, "--no-source").code == 3
    (run / "modules.npz").unlink()
    assert "has no modules.npz" in cdmisfa("bundle", run, "-o", out, "--no-source").err
    assert not out.exists()


def test_every_file_that_was_changed_is_named(
    bundle: Path, tmp_path: Path, cdmisfa: Cdmisfa
) -> None:
    files, path = members(bundle), tmp_path / "changed.zip"
    for name, data in files.items():
        place = bundle.read_bytes().index(data) + len(data) // 2
        changed = bytearray(bundle.read_bytes())
        changed[place] ^= 1
        path.write_bytes(changed)
        torn = cdmisfa("check", path)
        assert (torn.code, torn.err.count("\n")) == (3, 1)
        assert name in torn.err
        if name == METADATA:
            continue
        packed(path, {**files, name: data[:-1] + bytes([data[-1] ^ 1])})  # with a new checksum
        changed_again = cdmisfa("check", path)
        assert (changed_again.code, f"{name} was changed" in changed_again.err) == (3, True)
        packed(path, {n: d for n, d in files.items() if n != name})
        missing = cdmisfa("check", path)
        assert (missing.code, f"{name} is missing" in missing.err) == (3, True)
    for end in (0, 1, 30, len(bundle.read_bytes()) - 1):
        path.write_bytes(bundle.read_bytes()[:end])
        assert cdmisfa("check", path).code == 3


def with_member(info: zipfile.ZipInfo | str, data: bytes = b"x") -> Callable[[Members], bytes]:
    def made(files: Members) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as file:
            for name, old in files.items():
                file.writestr(name, old)
            file.writestr(info, data)
        return out.getvalue()

    return made


def link(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


def bomb(files: Members) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("run/run.mcap", bytes(50_000_000))
    return out.getvalue()


def lying(files: Members) -> bytes:
    """The directory says of a file that it is as long as many packages."""
    data = bytearray(with_member("run/zeros", bytes(1000))(files))
    at = data.rindex(b"PK\x01\x02")
    for field in (20, 24):
        data[at + field : at + field + 4] = (0x7FFFFFFF).to_bytes(4, "little")
    return bytes(data)


def overlapping(files: Members) -> bytes:
    """Many names of one file's bytes."""
    data = with_member("run/zeros", bytes(10_000))(files)
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        start, count = file.start_dir, len(file.infolist())
        size = len(data) - 22 - start
    entry = data[data.rindex(b"PK\x01\x02") : -22]
    more = [entry.replace(b"run/zeros", b"run/%05d" % i) for i in range(9000)]
    directory = data[start : start + size] + b"".join(more)
    ended = bytearray(data[-22:])
    ended[8:12] = (count + 9000).to_bytes(2, "little") * 2
    ended[12:16] = len(directory).to_bytes(4, "little")
    return data[:start] + directory + bytes(ended)


def encrypted(files: Members) -> bytes:
    data = bytearray(with_member("run/secret")(files))
    data[data.rindex(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def edited(change: Callable[[dict[str, dict[str, object]]], object]) -> Callable[[Members], bytes]:
    def made(files: Members) -> bytes:
        document = json.loads(files[METADATA])
        change({entity["@id"]: entity for entity in document["@graph"]})
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as file:
            for name, data in {**files, METADATA: json.dumps(document).encode()}.items():
                file.writestr(name, data)
        return out.getvalue()

    return made


HOSTILE = {
    "a way out": (with_member("../out"), "'../out' leads out of it"),
    "a way out below": (with_member("run/../../out"), "leads out of it"),
    "a path": (with_member("/tmp/cdmisfa-out"), "leads out of it"),
    "a link": (with_member(link("run/link"), b"/etc/passwd"), "is a link"),
    "a name that steers": (with_member("run/\x1b[31m"), "is no name of a file"),
    "a double": (with_member("run/run.json"), "several files of one name"),
    "a file beside": (with_member("run/more"), "knows nothing of run/more"),
    "a file below a file": (with_member("run/run.mcap/more"), "knows nothing of"),
    "a bomb": (bomb, "is compressed"),
    "sizes that lie": (lying, "other sizes than it says"),
    "files that overlap": (overlapping, "overlap"),
    "a secret": (encrypted, "is encrypted"),
    "no object": (edited(lambda g: g["#learn"].pop("object")), "does not describe the run"),
    "no hash": (edited(lambda g: g["run/run.mcap"].pop("sha256")), "knows nothing of run/run.mcap"),
    "a file that is none": (edited(lambda g: g["./"].update({"@type": "File"})), "./ is missing"),
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_bundles_are_refused(
    bundle: Path, tmp_path: Path, cdmisfa: Cdmisfa, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, why = HOSTILE[kind]
    inside = tmp_path / "tmp" / "deep"
    inside.mkdir(parents=True)
    monkeypatch.setattr("tempfile.tempdir", str(inside))
    path = tmp_path / "hostile.zip"
    path.write_bytes(make(members(bundle)))
    done = cdmisfa("check", path)
    assert (done.code, done.err.count("\n"), done.out) == (3, 1, ""), done.err
    assert why in done.err
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["deep", "hostile.zip", "tmp"]
    assert not Path("/tmp/cdmisfa-out").exists()


def test_a_bundle_leads_to_no_source_of_its_own(
    bundle: Path, tmp_path: Path, cdmisfa: Cdmisfa
) -> None:
    path = tmp_path / "f.zip"
    path.write_bytes(
        edited(lambda g: g["#learn"].update(object=[{"@id": "source/../../../../etc/"}]))(
            members(bundle)
        )
    )
    done = cdmisfa("check", path)
    assert (done.code, "name it with --source" in done.err) == (2, True)
    packed(path, {"some.txt": b"text"})
    assert (cdmisfa("check", path).code, cdmisfa("check", tmp_path / "none.zip").code) == (2, 2)


def test_the_commands_of_the_page_work(
    tmp_path: Path,
    cdmisfa: Cdmisfa,
    monkeypatch: pytest.MonkeyPatch,
    oscillatory_recording: Path,
) -> None:
    page = (ROOT / "docs" / "how-to" / "bundles.md").read_text("utf-8")
    (block,) = re.findall(r"^```sh\n(cdmisfa bundle.*?)^```$", page, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    shutil.copytree(oscillatory_recording, "recordings/streams")
    assert cdmisfa("learn", "recordings/streams", *SHORT, "-o", "runs/recorded").code == 0
    for line in block.splitlines():
        _, *words = shlex.split(line, comments=True)
        assert cdmisfa(*words).code == 0, line
