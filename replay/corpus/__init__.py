"""Many logs: an index of what is in them, and questions to it."""
