"""Putting source, learner and logs together: runs, sweeps, reproductions."""
