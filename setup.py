"""The kernels in C, the sample, and README for an index; everything else is in pyproject.toml."""

import re
import shutil
import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

PROJECT = tomllib.loads(Path("pyproject.toml").read_text("utf-8"))["project"]


class BuildWithSample(build_py):
    """What an installation holds, with the sample whose licence is that of the package."""

    def run(self) -> None:
        """See `build_py`."""
        super().run()
        samples = Path("sample_logs")
        for file in samples / "README.md", *sorted(samples.glob("oscillatory/*.mcap")):
            if not self.editable_mode:
                target = Path(self.build_lib, "cdmisfa", file)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, target)


def described(source: str | None) -> str:
    """README with whole addresses, as a page of an index needs them, whose files are elsewhere.

    Args:
        source: address of the repository; without one, pictures and links of it are left out.
    """

    def whole(found: re.Match[str]) -> str:
        picture, text, path = found.groups()
        if source is None:
            return "" if picture else text
        kind = "raw" if picture else "blob"
        return f"{picture}[{text}]({source}/{kind}/v{PROJECT['version']}/{path})"

    text = Path("README.md").read_text("utf-8")
    return re.sub(r"(!?)\[([^\]]+)\]\((?![a-z]+://)([^)\s]+)\)", whole, text)


setup(
    cffi_modules=["cdmisfa/kernels/build.py:wide", "cdmisfa/kernels/build.py:plain"],
    cmdclass={"build_py": BuildWithSample},
    long_description=described(PROJECT["urls"].get("Source")),
    long_description_content_type="text/markdown",
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
