"""Read and write MCAP files, without trust in what a file states."""
