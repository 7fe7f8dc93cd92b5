"""`cdmisfa doctor`: what this machine has, what it lacks, and what to do about it."""

from __future__ import annotations

import importlib.util
import os
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib import metadata

import click

from cdmisfa.cli import options
from cdmisfa.cli.printing import print_document, print_table
from cdmisfa.core.errors import CdmisfaError

NAMES = ("recorder", "replay")
"""Packages of ours beside `cdmisfa`, whose names others may have, too."""

PACKAGES = ("numpy", "cffi", "mcap", "protobuf", "rerun-sdk", "pyarrow")
"""Packages that no command can do without for long."""

EXTRAS = {
    "video": (("av",), "videos and cameras: learn, record, convert; export --to mp4"),
    "gym": (("gymnasium",), "gym: streams of simulated tasks; WatchEnv"),
    "rl": (("gymnasium", "stable_baselines3"), "examples/ppo.py"),
    "foxglove": (("websockets",), "foxglove:// streams of robots"),
    "cloud": (("aiohttp", "fsspec", "s3fs"), "logs behind URLs"),
    "paper": (("matplotlib",), "reproduce"),
    "ros": (("rosbags",), "ROS bags: learn, convert"),
    "sklearn": (("sklearn",), "RecursiveSFA and IncSFA, estimators of scikit-learn"),
    "river": (("river",), "OnlineSFA, a transformer of river"),
    "dask": (("distributed",), "--scheduler of sweep, apply and reproduce"),
}
"""Optional parts of the package: the modules they bring, and what needs them."""


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at; `needed_for` is empty where everything needs it."""

    what: str
    ok: bool
    detail: str
    needed_for: str = ""


@click.command("doctor")
@options.as_json
@click.pass_context
def doctor_command(ctx: click.Context, as_json: bool) -> None:
    """Say what this machine has and what it lacks.

    Exits with 1 when something is missing that every command needs.
    """
    checks = [check for look in LOOKS for check in look()]
    ok = all(check.ok or check.needed_for for check in checks)
    if as_json:
        rows = [asdict(check) for check in checks]
        print_document(ok=ok, checks=rows)
    else:
        words = [(("missing", "ok")[c.ok], c.what, c.detail, c.needed_for) for c in checks]
        print_table(("", "what", "detail", "needed for"), words)
    if not ok:
        ctx.exit(1)


def _python() -> Iterator[Check]:
    version = platform.python_version()
    yield Check("python", sys.version_info >= (3, 11), f"{version}, {platform.machine()}")


def _packages() -> Iterator[Check]:
    for name in ("cdmisfa", *PACKAGES):
        try:
            yield Check(name, True, metadata.version(name))
        except metadata.PackageNotFoundError:
            yield Check(name, False, f"pip install {name}")


def _extras() -> Iterator[Check]:
    for extra, (modules, needed_for) in EXTRAS.items():
        has = all(importlib.util.find_spec(module) is not None for module in modules)
        detail = "installed" if has else f"pip install 'cdmisfa[{extra}]'"
        yield Check(f"extra {extra}", has, detail, needed_for)


def _names() -> Iterator[Check]:
    owners = metadata.packages_distributions()
    for name in NAMES:
        if others := sorted(set(owners.get(name, ())) - {"cdmisfa"}):
            detail = f"also of {', '.join(others)}: give cdmisfa an environment of its own"
            yield Check(f"name {name}", False, detail)


def _simulator() -> Iterator[Check]:
    for name, module in (("pybullet", "pybullet"), ("icub-models", "icub_models")):
        if importlib.util.find_spec(module) is not None:
            try:
                detail = metadata.version(name)
            except metadata.PackageNotFoundError:
                detail = "unknown version"
            yield Check(name, True, detail, "the icub scene")
        else:
            remedy = f"pip install {name} (PyBullet has wheels for Python 3.11 and older)"
            yield Check(name, False, remedy, "the icub scene")


def _kernels() -> Iterator[Check]:
    try:
        from cdmisfa import kernels
    except CdmisfaError as error:
        yield Check("kernels", False, str(error), "learning")
        return
    detail = "for AVX2 and FMA" if kernels.WIDE else "for any processor: the same bits, slower"
    yield Check("kernels", True, detail, "learning")


def _vulkan() -> Iterator[Check]:
    from replay.viewer import vulkan_drivers

    drivers = vulkan_drivers()
    detail = ", ".join(d.stem for d in drivers) or "apt-get install mesa-vulkan-drivers"
    yield Check("vulkan driver", bool(drivers), detail, "view --screenshot without a screen")


def _screen() -> Iterator[Check]:
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    has = bool(shown) or sys.platform in ("darwin", "win32")
    detail = shown or ("native" if has else "none: use view --web, --save or --screenshot")
    yield Check("screen", has, detail, "view in a window")


LOOKS: tuple[Callable[[], Iterator[Check]], ...] = (
    _python,
    _packages,
    _names,
    _extras,
    _simulator,
    _kernels,
    _vulkan,
    _screen,
)
