"""A report: one HTML page that says what a run learned, and needs nothing but a browser."""
