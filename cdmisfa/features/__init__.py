"""Slow feature analysis: frames in, slow outputs out."""
