"""Studies of many runs: the paper's experiments and the demonstration."""
