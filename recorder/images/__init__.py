"""Images and numbers of external logs and cameras: decoded, and turned into frames."""
