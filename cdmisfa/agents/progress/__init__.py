"""The progress learner: one candidate for each stream, and attention to undecided streams."""
