"""Simulated worlds: what their streams show at every t."""
