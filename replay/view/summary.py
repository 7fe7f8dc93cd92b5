"""The results of a run as Markdown, for the first tab of its view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from cdmisfa.core.names import counted
from cdmisfa.core.signals import ACTIONS, STATE_WORDS, STATES
from replay.runs.run import Outline
from replay.view.writer import MOST_STREAMS

# Prefix of the event with the reason for the end of a run.
ENDED = "ended:"

# Settings that the summary names, by learner.
PAPER_SETTINGS = ("nu", "tau", "sigma", "delta")
PROGRESS_SETTINGS = ("tau", "components", "window", "attention")

# Most streams that are listed by name.
NAMED = 4


def summary_text(outline: Outline, name: str, events: Sequence[str] = ()) -> str:
    """Return the summary of a run as Markdown: modules or streams, reason for the end, settings.

    Args:
        outline: outline of the run.
        name: name of the run.
        events: texts of its events.
    """
    header, names, by_progress = outline.header, outline.names(), outline.header.by_progress
    lines = [
        f"## {name}",
        f"**{counted(len(outline.saved), 'module')} learned** in "
        f"{counted(outline.iterations, 'iteration', ',')} "
        f"({counted(outline.frames, 'frame', ',')} of {counted(len(names), 'stream')}).",
        "",
    ]
    lines += _of_streams(outline, events) if by_progress else _of_modules(outline)
    reasons = [text.removeprefix(ENDED).strip() for text in events if text.startswith(ENDED)]
    lines += [f"Stopped: {reason}.\n" for reason in reasons[-1:] if reason]
    if not by_progress:
        visits, frames = outline.visits, max(outline.frames, 1)
        shares = (
            (names[s], f"{visits[s]} frames, {visits[s] / frames:.0%}")
            for s in outline.streams(MOST_STREAMS)
        )
        lines += text_table(("stream", "attended"), shares)
    settings = [("seed", header.manifest.get("seed"))]
    keys = PROGRESS_SETTINGS if by_progress else PAPER_SETTINGS
    settings += [(key, header.setting("learner", key)) for key in keys]
    stated = ", ".join(f"{key} {value}" for key, value in settings if value is not None)
    return "\n".join([*lines, f"Settings: {stated}", ""])


def _of_modules(outline: Outline) -> list[str]:
    """Return the modules of a run of CD-MISFA, and the one that was not saved."""
    streams, last, rows = outline.names(), outline.last, []
    for save in outline.saved:
        eta = ", ".join(f"{value:.4f}" for value in save.eta)
        policy = policy_text(save.policy, streams)
        rows.append((save.module, streams[save.stream], save.iteration, eta, policy))
    head = "module", "stream", "iteration", "slowness [cycles/frame]", "policy"
    lines = text_table(head, rows) if rows else []
    if last is None or any(save.module == last.module for save in outline.saved):
        return lines
    most = int(last.novel_of.argmax())
    share = last.novel_of[most] / max(last.novel, 1)
    of_most = f"; {share:.0%} of the novel blocks came from {streams[most]}" if last.novel else ""
    unsaved = (
        f"Module {last.module} was not saved: {last.novel / last.blocks:.0%} of its "
        f"{last.blocks:,} blocks were novel{of_most}."
    )
    return [*lines, unsaved, ""]


def _of_streams(outline: Outline, events: Sequence[str]) -> list[str]:
    """Return the state of each stream of the progress learner, in the words of the events."""
    names = outline.names()
    outcomes: dict[str, str] = {}
    for text in events:
        if about := [name for name in names if text.startswith(f"stream {name} ")]:
            name = max(about, key=len)
            outcomes[name] = text.removeprefix(f"stream {name} ").removeprefix("is ")
    counts = Counter(outline.states)
    states = [(counts[code], words) for code, words in enumerate(STATE_WORDS)]
    lines = [", ".join(f"{count} {state}" for count, state in states if count), ""]
    for s in outline.streams(MOST_STREAMS):
        learning = outline.states[s] == STATES.index("learning")
        outcome = STATE_WORDS[0] if learning else outcomes.get(names[s], "")
        lines.append(f"- **{names[s]}**: {outcome}")
    more = len(names) - MOST_STREAMS
    return [*lines, "", *([f"{more} more streams were attended less.", ""] if more > 0 else [])]


def policy_text(policy: Sequence[int], streams: Sequence[str]) -> str:
    """Return a policy as text, as "stay on x1" or "stay on 40 of 78 streams"."""
    stay = ACTIONS.index("stay")
    stays = [s for s, action in zip(streams, policy, strict=True) if action == stay]
    if len(stays) == len(streams):
        return "stay on every stream"
    if len(stays) > NAMED:
        return f"stay on {len(stays)} of {len(streams)} streams"
    return f"stay on {', '.join(stays)}" if stays else "switch on every stream"


def text_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table, and an empty one behind it."""
    lines = [head, ["---"] * len(head), *rows]
    return [*(f"| {' | '.join(map(str, line))} |" for line in lines), ""]
