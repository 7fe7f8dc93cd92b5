"""The experiments of the paper: `cdmisfa reproduce`."""
