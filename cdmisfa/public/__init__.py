"""The Python interface: `learn`, `Run` and `Recording`."""
