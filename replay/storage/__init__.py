"""Where bytes lie, a path or URL: what is there, reading it, and results on their way there."""
