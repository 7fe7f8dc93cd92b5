"""A run in words, for the first page of its view."""

from __future__ import annotations

from replay.runs.outline import Outline
from replay.view.layout import MOST_STREAMS

NAMED = 4
"""Most streams whose names are given together."""


def summary_text(outline: Outline, name: str, ended: str = "") -> str:
    """What was learned, when, and where the robot stayed for it, as Markdown.

    Args:
        outline: the run in short.
        name: of the run.
        ended: why it ended, where that is known.
    """
    header = outline.header
    spec = header.spec
    lines = [f"## {name}", _opening(outline), ""]
    if outline.saved:
        lines += [
            "| module | stream | iteration | η [1/frame] | policy |",
            "|---|---|---|---|---|",
        ]
        for save in outline.saved:
            eta = ", ".join(f"{value:.4f}" for value in save.eta)
            lines.append(
                f"| {save.module} | {spec.streams[save.stream]} | {save.iteration} | {eta} "
                f"| {policy_text(save.policy, spec.streams)} |"
            )
        lines.append("")
    for text in (_unfinished(outline), ended):
        lines += [text, ""] if text else []
    lines += ["| stream | watched |", "|---|---|"]
    for s in outline.streams(MOST_STREAMS):
        share = outline.visits[s] / max(outline.frames, 1)
        lines.append(f"| {spec.streams[s]} | {outline.visits[s]} frames, {share:.0%} |")
    settings = [("seed", header.manifest.get("seed"))]
    settings += [(key, header.setting("learner", key)) for key in ("nu", "tau", "sigma")]
    settings += [("delta", header.delta)]
    said = ", ".join(f"{key} {value}" for key, value in settings if value is not None)
    lines += ["", said, ""]
    if header.missing:
        lines.append(f"Signals of version {header.schema}, without {', '.join(header.missing)}.")
    return "\n".join(lines)


def policy_text(policy: tuple[int, ...], streams: tuple[str, ...]) -> str:
    """Where a policy stays, as "stay on left"; the rest switches."""
    stays = [streams[s] for s, action in enumerate(policy) if action == 0]
    if len(stays) == len(streams):
        return "stay everywhere"
    if len(stays) > NAMED:
        return f"stay on {len(stays)} of {len(streams)} streams"
    return f"stay on {', '.join(stays)}" if stays else "switch everywhere"


def _unfinished(outline: Outline) -> str:
    """What became of the abstraction that was not saved."""
    last = outline.last
    if last is None or any(save.module == last.module for save in outline.saved):
        return ""
    most = int(last.visits.argmax())
    return (
        f"Module {last.module} was not saved: {last.novel / last.blocks:.0%} of its "
        f"{last.blocks:,} blocks were novel, and {last.visits[most] / last.blocks:.0%} of them "
        f"were of {outline.names()[most]}."
    )


def _opening(outline: Outline) -> str:
    learned = f"{len(outline.saved)} module{'' if len(outline.saved) == 1 else 's'} learned"
    return (
        f"**{learned}** in {outline.iterations:,} iterations "
        f"({outline.frames:,} frames of {len(outline.names())} streams)."
    )
