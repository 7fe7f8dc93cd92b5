"""Make small undamaged files of every kind."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path

from camera_files import pictures, write_cameras, write_pictures

from .commands import ROOT, must

EASY = tuple(
    word
    for key in ("delta=1.0", "eta_dot_window=3", "min_variance=0.0", "warm_up=0", "tau=20")
    for word in ("--set", f"learner.{key}")
)
"""Settings of learner 2.0 with which it learns a module soon."""


def recording(folder: Path) -> None:
    """Write a recording of the oscillatory streams."""
    must("record", "oscillatory", "-o", folder, "--frames", 300, "--seed", 5)


def parts(folder: Path) -> None:
    """Write the same recording in parts."""
    words = ("--frames", 300, "--seed", 5, "--split", "2s")
    must("record", "oscillatory", "-o", folder, *words)


def begun_recording(folder: Path) -> None:
    """Write a recording that was interrupted: two thirds of each file."""
    recording(folder)
    for path in folder.glob("*.mcap"):
        data = path.read_bytes()
        path.with_name(f"{path.name}.partial").write_bytes(data[: len(data) * 2 // 3])
        path.unlink()


def run(folder: Path) -> None:
    """Write a run of learner 2.0 with a module."""
    words = ("oscillatory", "-o", folder, "--seed", 1, *EASY, "--max-modules", 1, "--no-rerun")
    must("learn", *words, "--max-iterations", 400)


def begun_run(folder: Path) -> None:
    """Write a run that can be resumed."""
    words = ("oscillatory", "-o", folder, "--seed", 1, *EASY, "--no-rerun")
    must("learn", *words, "--max-iterations", 60)


def progress_run(folder: Path) -> None:
    """Write a run of the progress learner that can be resumed."""
    words = ("oscillatory", "-o", folder, "--algorithm", "progress", "--no-rerun")
    must("learn", *words, "--max-iterations", 60)


def preset(folder: Path) -> None:
    """Write two presets."""
    folder.mkdir()
    for name in ("oscillatory", "cameras"):
        text = (ROOT / "cdmisfa" / "presets" / f"{name}.toml").read_text("utf-8")
        (folder / f"{name}.toml").write_text(text)


def camera_log(folder: Path) -> None:
    """Write two cameras in an MCAP file."""
    folder.mkdir()
    write_cameras(folder / "a.mcap", {"/cam_left": (60, 20), "/cam_right": (60, 20)})


def png(folder: Path) -> None:
    """Write two folders of PNG files."""
    folder.mkdir()
    for name in ("left", "right"):
        write_pictures(folder / name, 30)


def images(folder: Path) -> None:
    """Write a recording of images."""
    png(folder.with_name("pictures"))
    sources = sorted(folder.with_name("pictures").iterdir())
    must("convert", *sources, "--rate", 25, "--size", "16x12", "-o", folder)


def ros1(folder: Path) -> None:
    """Write a ROS 1 bag."""
    from test_bags import ros1_bag

    folder.mkdir()
    ros1_bag(folder)


def ros2(folder: Path) -> None:
    """Write the database of a ROS 2 bag."""
    from test_bags import ros2_database

    folder.mkdir()
    path = ros2_database(folder)
    path.rename(folder / "cameras.db3")
    shutil.rmtree(path.parent)


def video(folder: Path, suffix: str = "mp4") -> None:
    """Write two videos."""
    from camera_files import write_video

    folder.mkdir()
    how = {"codec": "libx264", "pixels": "yuv420p"} if suffix == "mp4" else {}
    for seed, name in enumerate(("left", "right")):
        write_video(folder / f"{name}.{suffix}", pictures(40, seed), **how)


MAKERS: dict[str, Callable[[Path], None]] = {
    "recording": recording,
    "recording of images": images,
    "recording in parts": parts,
    "recording begun": begun_recording,
    "run": run,
    "run begun": begun_run,
    "progress run begun": progress_run,
    "preset": preset,
    "camera log": camera_log,
    "png": png,
    "bag": ros1,
    "db3": ros2,
    "mp4": video,
    "mkv": functools.partial(video, suffix="mkv"),
}
