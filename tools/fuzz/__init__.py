"""Fuzzing: broken logs by the million, and whatever else is decoded, guided by coverage."""
