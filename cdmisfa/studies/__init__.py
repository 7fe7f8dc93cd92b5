"""Studies of many runs: the paper's experiments, the arena, and the demonstration."""
