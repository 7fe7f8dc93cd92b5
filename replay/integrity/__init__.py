"""What is in a log, whether it is whole, and saving what can be saved."""
