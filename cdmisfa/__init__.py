"""Curiosity-driven modular incremental slow feature analysis (CD-MISFA 2.0)."""
