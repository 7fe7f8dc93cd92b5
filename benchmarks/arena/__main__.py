"""Compare learners on sets of streams: `python -m benchmarks.arena SET`.

The code is in comparison.py, because a spawned process cannot import functions of a `__main__`.
"""

from benchmarks.arena.comparison import main

if __name__ == "__main__":
    main()
