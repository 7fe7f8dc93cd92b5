"""Build the kernels in C and README for an index; everything else is in pyproject.toml."""

import re
import tomllib
from pathlib import Path

from setuptools import setup

PROJECT = tomllib.loads(Path("pyproject.toml").read_text("utf-8"))["project"]


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
    long_description=described(PROJECT["urls"].get("Source")),
    long_description_content_type="text/markdown",
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
