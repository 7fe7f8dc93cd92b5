"""The paper's own experiments, and the demonstration."""
