"""What a program or a notebook holds in hand: runs, recordings, and `learn`."""
