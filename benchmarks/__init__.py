"""Measurements of speed: `python -m benchmarks NAME`, each a ratio within one run."""
