"""`python -m cdmisfa` is the command `cdmisfa`."""

from cdmisfa.cli import main

if __name__ == "__main__":
    main()
