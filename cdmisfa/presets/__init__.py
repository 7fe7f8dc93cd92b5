"""TOML presets that hold the paper's numbers, each with its source."""
