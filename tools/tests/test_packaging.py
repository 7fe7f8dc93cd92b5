"""What is installed from a checkout, with a C compiler and without one."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from tools import installed

ROOT = Path(__file__).parents[2]

PIP = sys.executable, "-m", "pip", "--disable-pip-version-check"
DATED = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}

HASHED = """
import hashlib, numpy as np
from cdmisfa import kernels

print(kernels.__file__)
print(kernels.WIDE)
for module in (kernels._plain, kernels._module):
    kernels.lib, kernels.ffi, kernels._buffer = module.lib, module.ffi, module.ffi.from_buffer
    x, phi, offset = kernels.normal(np.random.default_rng(3), (40, 301), (5, 301), (5,))
    y = kernels.outputs(phi, offset, x)
    print(hashlib.sha256(x.tobytes() + y.tobytes() + kernels.sin(y).tobytes()).hexdigest())
"""


def run(*command: object, **options: object) -> str:
    done = subprocess.run(
        [*map(str, command)], capture_output=True, text=True, timeout=300, check=False, **options
    )
    if "(from versions: none)" in done.stderr:
        pytest.skip("pip reaches no index of packages: " + done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def listed() -> list[str]:
    """The files of the project."""
    if not (ROOT / ".git").exists():
        pytest.skip("this is no checkout, which says what its files are")
    names = run("git", "ls-files", "-z", "-co", "--exclude-standard", cwd=ROOT).split("\0")
    return [name for name in names if name and (ROOT / name).is_file()]


def pack(listed: list[str], folder: Path) -> Path:
    """Copy the project into a folder, and make a source archive there."""
    for name in listed:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
    hook = "import backend; backend.build_sdist('built')"
    path = folder / "cdmisfa" / "kernels"
    run(sys.executable, "-c", hook, cwd=folder, env={**DATED, "PYTHONPATH": path})
    (packed,) = folder.glob("built/*.tar.gz")
    return packed


@pytest.mark.parametrize("compiler", ["of the machine", "from PyPI"])
def test_what_is_installed_computes_the_same_bits(
    compiler: str, listed: list[str], tmp_path: Path
) -> None:
    built, other = tmp_path / "built", tmp_path / "environment"
    packed = pack(listed, tmp_path / "source")
    with tarfile.open(packed) as archive:
        names = {Path(*Path(name).parts[1:]) for name in archive.getnames()}
    assert {Path(name) for name in listed} <= names

    environment = {k: v for k, v in DATED.items() if k not in ("CC", "CFLAGS", "LDSHARED")}
    if compiler == "from PyPI":
        environment["PATH"] = str(tmp_path / "nothing")
    elif not any(map(shutil.which, ("cc", "gcc", "clang"))):
        pytest.skip("this machine has no C compiler")
    run(*PIP, "wheel", "--no-deps", "-w", built, packed, env=environment)
    (wheel,) = built.glob("*.whl")
    assert wheel.name.split("-")[2:4] == ["cp311", "abi3"]
    held = zipfile.ZipFile(wheel).namelist()
    assert {"lanes.h", "frames.c"} <= {Path(name).name for name in held}
    assert not any(name.endswith(".mcap") for name in held)
    if compiler == "of the machine":
        again = pack(listed, tmp_path / "elsewhere")
        assert again.read_bytes() == packed.read_bytes()
        run(*PIP, "wheel", "--no-deps", "-w", tmp_path / "again", again, env=environment)
        assert (tmp_path / "again" / wheel.name).read_bytes() == wheel.read_bytes()
        twine = pytest.importorskip("twine.commands.check")
        assert not twine.check([str(packed), str(wheel)], strict=True)

    venv.create(other, symlinks=True)
    python = other / "bin" / "python"
    run(*PIP, "--python", python, "install", "--no-deps", "--no-index", wheel)
    (packages,) = other.glob("lib/*/site-packages")
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    place, *found = run(python, "-c", HASHED, cwd=tmp_path).splitlines()
    assert place.startswith(str(packages))
    assert found == run(sys.executable, "-c", HASHED, cwd=ROOT).splitlines()[1:]
    assert len(set(found)) == 2
    if compiler == "of the machine":
        installed.use(other, installed.COMMANDS[:-1])  # the last takes long
