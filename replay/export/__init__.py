"""Export of runs and recordings for other programs: tables, images, videos, datasets."""
