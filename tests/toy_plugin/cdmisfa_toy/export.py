"""Exports: a recording as one picture of all it shows, a run's rewards as lines of text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from replay import Run
from replay.export import Form


def write_contact(source: Any, out: Path) -> int:
    """The first frame of each view, one above the other, as a PNG file."""
    views = [block.frames[0] for block in source.take_all(1)]
    Image.fromarray(np.vstack(views)).save(out, "PNG")
    return len(views)


def write_rewards(run: Path, out: Path) -> int:
    """The reward of each iteration, a line each."""
    rewards = Run(run).signals["reward"]
    out.write_text("".join(f"{reward:.6g}\n" for reward in rewards), "utf-8")
    return len(rewards)


CONTACT = Form("recording", write_contact, "views")
REWARDS = Form("run", write_rewards, "rewards")
