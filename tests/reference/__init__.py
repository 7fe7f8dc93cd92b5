"""What the kernels compute, once more, in plain Python and numpy."""
