"""Other people's logs of cameras as sources of frames."""
