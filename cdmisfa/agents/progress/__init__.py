"""Learn from any camera: one candidate a stream, and attention to undecided streams."""
