"""Basics of all packages: blocks, signals, configuration, errors, registries, processes."""
