"""The MCAP file: read with no trust in what it says, and written."""
