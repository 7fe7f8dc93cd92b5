"""The decaying epsilon-greedy choice between stay and switch."""

from __future__ import annotations

from cdmisfa.core.arithmetic.compiled import compiled


@compiled
def decay(epsilon: float, slow: float, knee: float, fast: float) -> float:
    """Epsilon after one more iteration: times `slow` above the knee, times `fast` below.

    Source: paper, Oscillatory Streams Environment (.999, .8, .95).
    """
    return epsilon * (slow if epsilon > knee else fast)


@compiled
def choose(epsilon: float, greedy: int, coin: float, draw: float) -> tuple[int, bool]:
    """Action and whether it was random: with probability min(epsilon, 1) either of the two.

    Args:
        epsilon: probability; above 1 counts as 1.
        greedy: the policy's action, 0 stay or 1 switch.
        coin: uniform in [0, 1), decides whether to explore.
        draw: uniform in [0, 1), decides the random action.
    """
    if coin < epsilon:
        return (1 if draw >= 0.5 else 0), True
    return greedy, False


@compiled
def other_stream(stream: int, n_streams: int, draw: float) -> int:
    """One of the n-1 other streams, uniformly; the same one where there is no other.

    Args:
        stream: stream to leave.
        n_streams: number n of streams.
        draw: uniform in [0, 1).
    """
    if n_streams == 1:
        return stream
    offset = 1 + min(int(draw * (n_streams - 1)), n_streams - 2)
    return (stream + offset) % n_streams
