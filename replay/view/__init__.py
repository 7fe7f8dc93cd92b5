"""Rerun views of runs and recordings."""
