"""For all: blocks, signals, modules, configuration, errors, registries, processes."""
