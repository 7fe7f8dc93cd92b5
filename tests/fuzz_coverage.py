"""Let atheris change whole logs, guided by what they reach in the reader.

pip install -e '.[fuzz]'
python tests/fuzz_coverage.py 300       # seconds
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["replay"]):
    import fuzz

import fuzz_mutations
import fuzz_oracle
from fuzz_mutations import Case

CORPUS = fuzz.STATE / "corpus"


def main() -> None:
    """Run for a while, or until something breaks; the log that did is kept."""
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    CORPUS.mkdir(parents=True, exist_ok=True)
    for name, raw in fuzz_mutations.bases().items():
        (CORPUS / name.replace(" ", "-")).write_bytes(raw)
    path = Path(tempfile.mkdtemp(dir=fuzz.memory_folder())) / "log.mcap"
    runs = 0

    def one(raw: bytes) -> None:
        nonlocal runs
        runs += 1
        try:
            # As a recording, so that it is played, too.
            fuzz_oracle.check(Case(raw, "recording", trusted=False), path, runs)
        except Exception:
            print(f"kept {fuzz.keep(Case(raw, '', trusted=False))}")
            raise

    options = ["-rss_limit_mb=2048", "-max_len=8192", f"-max_total_time={seconds}"]
    atheris.Setup([sys.argv[0], *options, str(CORPUS)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
