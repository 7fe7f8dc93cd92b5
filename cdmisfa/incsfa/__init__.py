"""Incremental slow feature analysis."""
