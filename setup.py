"""The kernels in C; everything else is in pyproject.toml."""

from setuptools import setup

setup(
    cffi_modules=["cdmisfa/kernels/build.py:wide", "cdmisfa/kernels/build.py:plain"],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
