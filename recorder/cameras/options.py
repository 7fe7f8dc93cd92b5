"""How live streams become streams of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from cdmisfa.core.options import setting
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
