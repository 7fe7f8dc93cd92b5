"""Recordings on disk: one MCAP file for each view."""
