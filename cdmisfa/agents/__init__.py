"""Where to look, and when to save what was learned."""
