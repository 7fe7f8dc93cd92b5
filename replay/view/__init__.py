"""Rerun views of runs and recordings."""

import os

# Rerun prints three lines about a full disk or a thread; the error that it raises is printed once.
os.environ.setdefault("RUST_LOG", "off")
