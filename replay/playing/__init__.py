"""A recording played in real time, to a viewer or as if it were a running robot."""
