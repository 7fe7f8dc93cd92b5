"""What Rerun shows of runs and recordings."""
