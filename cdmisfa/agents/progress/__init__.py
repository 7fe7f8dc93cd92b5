"""Learn from any camera: one candidate a stream, and attention to what is being learned."""
