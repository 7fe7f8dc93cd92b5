"""Learners: they choose a stream, learn slow features of it, and save modules."""
