"""How live streams become streams of frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from cdmisfa.core.options import DURATION, setting
from recorder.images.options import ImageOptions

OnLoss = Literal["reconnect", "wait", "end"]
"""What is done about a camera that stalls or goes away."""

HOLD: Final = 0.25
"""Seconds for which a picture stands for those that are missing."""

STALL: Final = 5.0
"""Seconds without a picture after which a camera is said to have stalled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions(ImageOptions):
    """How live streams become streams of frames.

    Attributes:
        seed: of simulated tasks.
    """

    hold: float = setting(
        HOLD,
        "How long a picture of a live stream stands for those that are missing; then it has a gap.",
        unit="SECONDS",
        least=0.0,
        most=1e6,
        group="Live streams",
    )
    on_loss: OnLoss = setting(
        "reconnect",
        "What to do about a live stream that stalls or goes away.",
        name="lost",
        group="Live streams",
    )
    stall: float = setting(
        STALL,
        "A live stream without a picture for so long has stalled.",
        unit="SECONDS",
        least=0.1,
        most=1e6,
        group="Live streams",
    )
    seed: int = 0


AROUND: Final = 5.0
"""Seconds that are kept before and after what is novel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TriggerOptions:
    """Which frames of a source are recorded; by default all."""

    when: Literal["novel"] | None = setting(
        None, "Record only what is novel, and what was before and after it.", group="Source"
    )
    known: Path | None = setting(
        None, "A run: what its modules know is not novel, with --when.", unit="RUN", group="Source"
    )
    before: float = setting(
        AROUND,
        "How much is recorded before what is novel, with --when.",
        unit=DURATION,
        group="Source",
    )
    after: float = setting(
        AROUND,
        "How much is recorded after it, with --when.",
        unit=DURATION,
        group="Source",
    )
