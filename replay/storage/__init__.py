"""Files and URLs: find logs, read arrays, and compute the identity of a log."""
