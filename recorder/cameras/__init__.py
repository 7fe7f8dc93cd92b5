"""Live streams from outside: cameras, robots, simulated tasks, and arrays of the caller."""
