"""Images and numbers of external logs and cameras, and their conversion to frames."""
