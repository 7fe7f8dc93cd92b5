"""Many logs: an index of their streams, and many logs as episodes of one source."""
