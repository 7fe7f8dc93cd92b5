"""Reading of logs and runs of cdmisfa, and showing what they hold."""
