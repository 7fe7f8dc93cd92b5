"""Fuzzing: broken MCAP logs by number, and every other decoder guided by coverage."""
