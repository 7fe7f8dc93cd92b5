"""Slow feature analysis: batch, incremental and recursive."""
