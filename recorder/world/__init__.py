"""Simulated scenes: the iCub at a table, and the oscillatory streams."""
