"""Runs on disk: signals, modules and results."""
