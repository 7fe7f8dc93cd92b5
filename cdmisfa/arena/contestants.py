"""The learners that are compared, each a name for a configuration.

Beside the progress learner and the paper's own there is the progress learner with every other
rule for choosing the stream to watch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cdmisfa.agents.progress.config import ATTENTIONS
from cdmisfa.core.registry import Registry
from cdmisfa.experiments.sources import configure

CONTESTANTS: Registry[tuple[str, ...]] = Registry(
    "learner of the arena",
    {
        "progress": ("learner.algorithm=progress",),
        "2.0": ("learner.algorithm=2.0",),
        "1.0": ("learner.algorithm=1.0",),
        **{
            name: ("learner.algorithm=progress", f"learner.attention={name}")
            for name in ATTENTIONS
            if name != "progress"
        },
    },
)
"""Settings of every learner, over its preset; `CONTESTANTS.add` adds one."""


def configured(name: str, settings: Sequence[str], *, images: bool) -> Any:
    """The configuration of a learner.

    Args:
        name: in `CONTESTANTS`.
        settings: `section.key=value` words that win over its own.
        images: frames are pictures, and not the few values of the oscillatory streams.

    Raises:
        UsageError: no such learner or key, or a value that does not fit.
    """
    scene = "icub" if images else "oscillatory"
    return configure(scene, settings=(*CONTESTANTS[name], *settings)).learner
