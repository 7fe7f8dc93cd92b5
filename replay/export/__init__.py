"""Runs and recordings for other programs: tables, images, videos, datasets."""
