"""Describe, verify and recover logs."""
