"""The arena: learners compared on sets of streams, each made anew where it is run."""
