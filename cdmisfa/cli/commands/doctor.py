"""`cdmisfa doctor`: check which software is installed, and print how to install the rest."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.util import find_spec

import click

from cdmisfa.cli import options, printing
from cdmisfa.core.errors import CdmisfaError

REQUIRED = ("cdmisfa", "numpy", "cffi", "mcap", "protobuf", "rerun-sdk", "pyarrow", "av",
            "rosbags")  # fmt: skip

# Optional dependencies by the name of the extra: modules, and features that need them.
EXTRAS = {
    "gym": (("gymnasium",), "gym: streams of simulated tasks; WatchEnv"),
    "rl": (("gymnasium", "stable_baselines3"), "examples/ppo.py"),
    "foxglove": (("websockets",), "foxglove:// streams of robots"),
    "cloud": (("aiohttp", "fsspec", "s3fs"), "logs behind URLs"),
    "paper": (("matplotlib",), "reproduce"),
    "sklearn": (("sklearn",), "RecursiveSFA and IncSFA, estimators of scikit-learn"),
    "river": (("river",), "OnlineSFA, a transformer of river"),
    "dask": (("distributed",), "--scheduler of sweep, apply and reproduce"),
}


@dataclass(frozen=True, slots=True)
class Check:
    """Result of checking one component.

    Attributes:
        what: name of the component.
        ok: whether it is installed.
        detail: its version, or the command that installs it.
        needed_for: features that need it; "" if every command does.
    """

    what: str
    ok: bool
    detail: str
    needed_for: str = ""


@options.command("doctor")
@click.argument("files", nargs=-1, metavar="")
@options.as_json
def doctor_command(files: tuple[str, ...], as_json: bool) -> int:
    """Check which required and optional software is installed.

    The command prints for each missing package how to install it and what needs it. The exit code
    is 1 if something is missing that every command needs. To check a log, use cdmisfa verify.

    Examples:
        cdmisfa doctor
        cdmisfa doctor --json
        cdmisfa verify left.mcap
    """
    if files:
        command = f"cdmisfa verify {shlex.join(files)}"
        raise click.UsageError(f"doctor checks this machine, not files: check files with {command}")
    checks = [*_check_packages(), *_check_kernels(), *_check_display()]
    ok = all(check.ok or check.needed_for for check in checks)
    if as_json:
        printing.document(ok=ok, checks=[asdict(check) for check in checks])
    else:
        rows = [("ok" if c.ok else "missing", c.what, c.detail, c.needed_for) for c in checks]
        printing.table(("", "component", "detail", "needed for"), rows)
    return 0 if ok else 1


def _check_packages() -> Iterator[Check]:
    version = platform.python_version()
    yield Check("python", sys.version_info >= (3, 11), f"{version}, {platform.machine()}")
    for name in REQUIRED:
        yield _check_package(name, f"pip install {name}", "")
    for extra, (modules, needed_for) in EXTRAS.items():
        ok = all(find_spec(module) is not None for module in modules)
        detail = "installed" if ok else f"pip install 'cdmisfa[{extra}]'"
        yield Check(f"extra {extra}", ok, detail, needed_for)
    for name in ("pybullet", "icub-models"):
        remedy = f"pip install {name} (PyBullet has wheels for Python 3.11 and older)"
        yield _check_package(name, remedy, "the icub scene")


def _check_package(name: str, remedy: str, needed_for: str) -> Check:
    try:
        return Check(name, True, metadata.version(name), needed_for)
    except metadata.PackageNotFoundError:
        return Check(name, False, remedy, needed_for)


def _check_kernels() -> Iterator[Check]:
    try:
        from cdmisfa import kernels
    except CdmisfaError as error:
        yield Check("kernels", False, str(error), "learning")
        return
    detail = "for AVX2 and FMA" if kernels.WIDE else "for any processor: the same bits, slower"
    yield Check("kernels", True, detail, "learning")


def _check_display() -> Iterator[Check]:
    from replay.viewer import vulkan_drivers

    drivers = vulkan_drivers()
    detail = ", ".join(driver.stem for driver in drivers) or "apt-get install mesa-vulkan-drivers"
    yield Check("vulkan driver", bool(drivers), detail, "view --screenshot without a screen")
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ok = bool(display) or sys.platform in ("darwin", "win32")
    detail = display or ("native" if ok else "none: use view --web, --save or --screenshot")
    yield Check("screen", ok, detail, "view in a window")
