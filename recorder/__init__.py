"""Simulated and live streams of cdmisfa, and the recording of any source."""
