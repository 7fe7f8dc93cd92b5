"""Find the bad episodes of a dataset, with the reasons."""
