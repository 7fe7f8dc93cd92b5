"""Learn from any camera: one candidate a stream, and attention by the progress of learning."""
