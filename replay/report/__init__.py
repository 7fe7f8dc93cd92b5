"""Reports: one HTML page about a run, or about several, that needs nothing but a browser."""
