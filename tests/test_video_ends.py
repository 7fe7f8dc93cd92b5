"""A video that lost its end is told from a whole one by what its container states."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from camera_files import pictures, write_video
from conftest import Cdmisfa

FRAMES = 40
FRAGMENTS = {"movflags": "frag_keyframe+empty_moov", "g": "5"}
UNKNOWN = "it does not state its length, so a missing end cannot be detected"

STATED: dict[str, tuple[str, str, str, Mapping[str, str]]] = {
    # kind: ending, codec, pixels, options of the container
    "mp4": ("mp4", "libx264", "yuv420p", {}),
    "mp4, index first": ("mp4", "libx264", "yuv420p", {"movflags": "faststart"}),
    "mp4 in fragments": ("mp4", "mpeg4", "yuv420p", FRAGMENTS),
    "mov": ("mov", "mjpeg", "yuvj420p", {}),
    "mkv": ("mkv", "ffv1", "gray", {}),
    "mkv, small clusters": ("mkv", "libx264", "yuv420p", {"cluster_time_limit": "200"}),
    "webm": ("webm", "libvpx-vp9", "yuv420p", {}),
    "avi": ("avi", "mjpeg", "yuvj420p", {}),
}


NOT_STATED: dict[str, tuple[str, str, str, Mapping[str, str]]] = {
    "mkv, live": ("mkv", "ffv1", "gray", {"live": "1"}),
    "fragments without an index": (
        *("mp4", "mpeg4", "yuv420p"),
        {"movflags": "frag_keyframe+empty_moov+skip_trailer"},
    ),
    "mpeg": ("mpg", "mpeg1video", "yuv420p", {}),
    "wmv": ("wmv", "wmv2", "yuv420p", {}),
}
"""Containers that state where they end."""


def written(
    tmp_path: Path, ending: str, codec: str, pixels: str, options: Mapping[str, str], **more: int
) -> Path:
    path = tmp_path / f"film.{ending}"
    write_video(path, pictures(FRAMES), codec=codec, pixels=pixels, options=options, **more)
    return path


@pytest.mark.parametrize("kind", STATED)
def test_a_whole_video_is_whole(cdmisfa: Cdmisfa, tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, *STATED[kind])
    done = cdmisfa("verify", path)
    assert (done.code, done.out.splitlines()[0]) == (0, f"{path}: whole")
    assert UNKNOWN not in done.out


@pytest.mark.parametrize("share", [0.4, 0.6, 0.95, 1])
@pytest.mark.parametrize("kind", STATED)
def test_a_cut_video_is_cut_in_every_command(
    cdmisfa: Cdmisfa, tmp_path: Path, kind: str, share: float
) -> None:
    path = written(tmp_path, *STATED[kind])
    data = path.read_bytes()
    path.write_bytes(data[: min(int(len(data) * share), len(data) - 1)])
    check, info = cdmisfa("verify", path, "--json"), cdmisfa("info", path, "--json")
    plan = cdmisfa("convert", path, "-o", tmp_path / "rec", "--json")
    assert (check.code, check.json["ok"], info.code) == (3, False, 3)
    if plan.code == 3:  # without its index it holds no frame that can be found
        index = kind in ("mp4", "mov")
        assert ("its index (moov), which cameras write last, is incomplete" in plan.err) == index
        assert plan.err.startswith(f"cdmisfa: {path}: ")
        assert " cut short: the file ends at byte " in plan.err
        assert (plan.err.count("\n"), info.err) == (1, plan.err)
        return
    assert plan.code == 0, plan.err
    assert 0 < plan.json["views"][0]["frames"] <= FRAMES
    (missing,) = {p["what"] for p in info.json["problems"]}
    assert (check.json["state"], info.json["state"]) == ("cut short", "cut short")
    assert missing in [p["what"] for p in check.json["problems"]]
    assert f"warning: {path}: {missing}\n" in plan.err
    assert f"the file ends at byte {path.stat().st_size}," in missing


@pytest.mark.parametrize("kind", ["mp4 in fragments", "mkv", "avi"])
def test_an_end_of_zeros_is_no_end(cdmisfa: Cdmisfa, tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, *STATED[kind])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))
    for command in ("verify", "info"):
        done = cdmisfa(command, path)
        assert done.code == 3, (command, done.out, done.err)
    assert "zeros at byte" in done.out


@pytest.mark.parametrize("kind", NOT_STATED)
def test_what_does_not_state_its_end_is_whole_with_a_remark(
    cdmisfa: Cdmisfa, tmp_path: Path, kind: str
) -> None:
    path = written(tmp_path, *NOT_STATED[kind])
    done = cdmisfa("verify", path)
    assert (done.code, f"{path}: {UNKNOWN}" in done.out) == (0, True), done.out
    assert f"{path}: {UNKNOWN}" in cdmisfa("info", path).out
    learned = cdmisfa("learn", path, "--max-iterations", 1)
    assert UNKNOWN not in learned.err  # nobody can act on it there


@pytest.mark.parametrize(("ending", "codec"), [("avi", "libx264"), ("mpg", "libx264")])
def test_frames_without_times_are_refused_and_not_called_damaged(
    cdmisfa: Cdmisfa, tmp_path: Path, ending: str, codec: str
) -> None:
    """An AVI file states none, and pictures that wait for later ones (B-frames) need them."""
    path = written(tmp_path, ending, codec, "yuv420p", {})
    for command in ("verify", "info", "learn"):
        done = cdmisfa(command, path)
        assert (done.code, done.err.count("\n")) == (2, 1), (command, done.err)
        assert f"{path}: its frames have no times" in done.err
