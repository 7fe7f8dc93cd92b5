"""One run, or many: sources, learners and logs put together."""
