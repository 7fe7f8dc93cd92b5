"""Reader and writer of MCAP files; the reader does not trust the content of a file."""
