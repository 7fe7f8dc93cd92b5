"""Files of every kind, undamaged, small, and made by the commands of the project."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path

from camera_files import pictures, write_cameras, write_pictures
from PIL import Image

from .commands import ROOT, must

EASY = tuple(
    word
    for key in ("delta=1.0", "eta_dot_window=3", "min_variance=0.0", "warm_up=0", "tau=20")
    for word in ("--set", f"learner.{key}")
)
"""Settings of 2.0 with which a module is learned soon."""


def recording(folder: Path) -> None:
    """Of the oscillatory streams."""
    must(folder.parent, "record", "oscillatory", "-o", folder, "--frames", 300, "--seed", 5)


def parts(folder: Path) -> None:
    """The same in parts."""
    words = ("--frames", 300, "--seed", 5, "--split", "2s")
    must(folder.parent, "record", "oscillatory", "-o", folder, *words)


def begun_recording(folder: Path) -> None:
    """One that was killed: its files are a part of what they would be."""
    recording(folder)
    for path in folder.glob("*.mcap"):
        data = path.read_bytes()
        path.with_name(f"{path.name}.partial").write_bytes(data[: len(data) * 2 // 3])
        path.unlink()


def run(folder: Path) -> None:
    """A run of 2.0 with a module, on a live scene."""
    words = ("oscillatory", "-o", folder, "--seed", 1, *EASY, "--max-modules", 1, "--no-rerun")
    must(folder.parent, "learn", *words, "--max-iterations", 400)


def begun_run(folder: Path) -> None:
    """A run that may go on, with its keyframes."""
    words = ("oscillatory", "-o", folder, "--seed", 1, *EASY, "--no-rerun")
    must(folder.parent, "learn", *words, "--max-iterations", 60)


def progress_run(folder: Path) -> None:
    """A run of the progress learner that may go on."""
    words = ("oscillatory", "-o", folder, "--algorithm", "progress", "--no-rerun")
    must(folder.parent, "learn", *words, "--max-iterations", 60)


def preset(folder: Path) -> None:
    """A preset of the project."""
    folder.mkdir()
    for name in ("oscillatory", "cameras"):
        text = (ROOT / "cdmisfa" / "presets" / f"{name}.toml").read_text("utf-8")
        (folder / f"{name}.toml").write_text(text)


def sweep(folder: Path) -> None:
    """A finished sweep."""
    words = ("--grid", "learner.nu=0.03,0.05", "--seeds", "0:2", "--max-iterations", 3)
    must(folder.parent, "sweep", "oscillatory", *words, "-o", folder)


def camera_log(folder: Path) -> None:
    """Two cameras in an MCAP file."""
    folder.mkdir()
    write_cameras(folder / "a.mcap", {"/cam_left": (60, 20), "/cam_right": (60, 20)})


def png(folder: Path) -> None:
    """Two folders of PNG files."""
    folder.mkdir()
    for name in ("left", "right"):
        write_pictures(folder / name, 30)


def images(folder: Path) -> None:
    """A recording of images."""
    png(folder.with_name("pictures"))
    sources = sorted(folder.with_name("pictures").iterdir())
    must(folder.parent, "convert", *sources, "--rate", 25, "--size", "16x12", "-o", folder)


def jpg(folder: Path) -> None:
    """Two folders of JPEG files."""
    for seed, name in enumerate(("left", "right")):
        (folder / name).mkdir(parents=True)
        for i, image in enumerate(pictures(30, seed)):
            Image.fromarray(image).save(folder / name / f"{i}.jpg")


def ros1(folder: Path) -> None:
    """A bag of ROS 1."""
    from test_bags import ros1_bag

    folder.mkdir()
    ros1_bag(folder)


def ros2(folder: Path) -> None:
    """The database of a bag of ROS 2."""
    from test_bags import ros2_database

    folder.mkdir()
    path = ros2_database(folder)
    path.rename(folder / "cameras.db3")
    shutil.rmtree(path.parent)


def video(folder: Path, suffix: str = "mp4") -> None:
    """Two videos."""
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
    "sweep": sweep,
    "camera log": camera_log,
    "png": png,
    "jpg": jpg,
    "bag": ros1,
    "db3": ros2,
    "mp4": video,
    "mkv": functools.partial(video, suffix="mkv"),
}


def missing() -> list[str]:
    """Kinds that need a package which is not installed."""
    import importlib.util

    needs = {"bag": "rosbags", "db3": "rosbags", "mp4": "av", "mkv": "av"}
    return [kind for kind, name in needs.items() if importlib.util.find_spec(name) is None]
