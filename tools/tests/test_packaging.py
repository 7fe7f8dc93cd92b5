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

ROOT = Path(__file__).parents[2]

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


@pytest.mark.parametrize("compiler", ["of the machine", "from PyPI"])
def test_what_is_installed_computes_the_same_bits(compiler: str, tmp_path: Path) -> None:
    source, built, other = tmp_path / "source", tmp_path / "built", tmp_path / "environment"
    listed = run("git", "ls-files", "-z", "-co", "--exclude-standard", cwd=ROOT).split("\0")
    for name in filter(lambda name: name and (ROOT / name).is_file(), listed):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    built.mkdir()
    hook = f"import backend; backend.build_sdist({str(built)!r})"
    run(
        sys.executable,
        "-c",
        hook,
        cwd=source,
        env={**os.environ, "PYTHONPATH": source / "cdmisfa/kernels"},
    )
    (packed,) = built.glob("*.tar.gz")
    with tarfile.open(packed) as archive:
        names = {Path(*Path(name).parts[1:]) for name in archive.getnames()}
    assert {Path(name) for name in listed if name.startswith("cdmisfa/kernels/")} <= names

    environment = {k: v for k, v in os.environ.items() if k not in ("CC", "CFLAGS", "LDSHARED")}
    if compiler == "from PyPI":
        environment["PATH"] = str(tmp_path / "nothing")
    elif not any(map(shutil.which, ("cc", "gcc", "clang"))):
        pytest.skip("this machine has no C compiler")
    pip = sys.executable, "-m", "pip", "--disable-pip-version-check"
    run(*pip, "wheel", "--no-deps", "-w", built, packed, env=environment)
    (wheel,) = built.glob("*.whl")
    assert wheel.name.split("-")[2:4] == ["cp311", "abi3"]
    assert {"lanes.h", "frames.c"} <= {
        Path(name).name for name in zipfile.ZipFile(wheel).namelist()
    }

    venv.create(other, symlinks=True)
    python = other / "bin" / "python"
    run(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel)
    (packages,) = other.glob("lib/*/site-packages")
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    place, *found = run(python, "-c", HASHED, cwd=tmp_path).splitlines()
    assert place.startswith(str(packages))
    assert found == run(sys.executable, "-c", HASHED, cwd=ROOT).splitlines()[1:]
    assert len(set(found)) == 2
