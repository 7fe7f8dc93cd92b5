"""What attacks the product for longer than tests take: campaigns and fuzzing, and their tests."""

from __future__ import annotations

import sys
from pathlib import Path

HELPERS = str(Path(__file__).resolve().parents[1] / "tests")
if HELPERS not in sys.path:  # makers of logs and cameras, which the tests have too
    sys.path.insert(0, HELPERS)
