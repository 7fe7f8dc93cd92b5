"""The world: simulated streams, and writing what they show."""
