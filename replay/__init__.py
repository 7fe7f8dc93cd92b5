"""Reading logs, and showing what happened."""
