"""Simulated and live streams of cdmisfa, and the recording of what any source shows."""
