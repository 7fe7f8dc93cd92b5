"""The formats of logs, a module each."""
