"""Our recordings as sources of frames."""
