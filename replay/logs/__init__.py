"""Recordings and external logs as sources of frames."""
