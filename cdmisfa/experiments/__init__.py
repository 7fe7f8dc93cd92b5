"""Runs, sweeps and applications: the code that connects sources, learners and logs."""
