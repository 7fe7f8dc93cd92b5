"""The arena: compare learners on sets of streams, `python -m benchmarks.arena SET`."""
