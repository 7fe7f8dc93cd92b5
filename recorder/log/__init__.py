"""Recordings on disk: one MCAP file a view, written whole or not at all."""
