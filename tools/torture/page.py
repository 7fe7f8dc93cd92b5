"""What all cases came to: a document, a page, a few lines."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from .campaigns import CAMPAIGNS, campaign
from .outcomes import DEFECTS, GOOD, MEANING

MOST_SHOWN = 20
"""Defects of a campaign that are told one by one."""


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts by campaign and group, and every defect."""
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    seconds: dict[str, float] = defaultdict(float)
    memory: dict[str, int] = defaultdict(int)
    defects = []
    for line in lines:
        if "run" in line:
            continue
        name = line["campaign"]
        counts[name, line["group"]][line["kind"]] += line["count"]
        seconds[name] += line["seconds"]
        memory[name] = max(memory[name], line["megabytes"])
        if "defect" in line:
            defects.append({k: line[k] for k in ("campaign", "seed", "kind", "group", "detail")})
    names = [name for name in CAMPAIGNS if name in seconds]
    return {
        "schema": 1,
        "runs": [line["run"] for line in lines if "run" in line],
        "campaigns": [
            {
                "name": name,
                "cases": sum(sum(c.values()) for (of, _), c in counts.items() if of == name),
                "hours": round(seconds[name] / 3600, 2),
                "peak_megabytes": memory[name],
                "groups": [
                    {"group": group, **counts[of, group]}
                    for of, group in sorted(counts)
                    if of == name
                ],
            }
            for name in names
        ],
        "defects": defects,
    }


def short(found: dict[str, Any]) -> str:
    """A line for each campaign, and one for all."""
    rows = []
    for each in found["campaigns"]:
        kinds: Counter[str] = Counter()
        for group in each["groups"]:
            kinds.update({k: n for k, n in group.items() if k != "group"})
        told = ", ".join(f"{kinds[kind]} {kind}" for kind in (*GOOD, *DEFECTS) if kinds[kind])
        rows.append(f"{each['name']}: {each['cases']} cases: {told}")
    return "\n".join([*rows, f"{len(found['defects'])} defects"])


def markdown(found: dict[str, Any]) -> str:
    """The page."""
    cases = sum(each["cases"] for each in found["campaigns"])
    hours = sum(each["hours"] for each in found["campaigns"])
    runs = found["runs"]
    lines = [
        "# What was done to it, and what came of that",
        "",
        "Made by `make torture`, then `python -m tools.torture --minutes 0 --page "
        "docs/reliability.md`;",
        "figures are of the runs named here, failures included. A defect is told as it was",
        "found; the command behind it repeats its case with the code of today.",
        "",
        f"{cases} cases in {hours:.1f} hours of work, {len(found['defects'])} defects. "
        f"Commit {_distinct(runs, 'commit')}; Python {_distinct(runs, 'python')}; "
        f"{_distinct(runs, 'platform')}; first seeds {_distinct(runs, 'seed')}.",
        "",
        *(f"- **{kind}**: {MEANING[kind]}" for kind in (*GOOD, *DEFECTS)),
        "",
    ]
    for each in found["campaigns"]:
        lines += _section(each, [d for d in found["defects"] if d["campaign"] == each["name"]])
    return "\n".join(lines)


def _distinct(runs: Sequence[dict[str, Any]], key: str) -> str:
    return ", ".join(dict.fromkeys(str(run[key]) for run in runs))


def _section(each: dict[str, Any], defects: Sequence[dict[str, Any]]) -> list[str]:
    kinds = [*GOOD[:2]]
    kinds += [k for k in (*GOOD[2:], *DEFECTS) if any(group.get(k) for group in each["groups"])]
    about = (campaign(each["name"]).__doc__ or "").strip().partition("\n\n")[0]
    lines = [
        f"## {each['name']}",
        "",
        about,
        "",
        f"| | cases | {' | '.join(kinds)} |",
        f"|---|{'---:|' * (len(kinds) + 1)}",
    ]
    for group in each["groups"]:
        counts = [group.get(kind, 0) for kind in kinds]
        lines.append(f"| {group['group']} | {sum(counts)} | {' | '.join(map(str, counts))} |")
    lines += ["", f"Most memory of one process: {each['peak_megabytes']} MB.", ""]
    for defect in defects[:MOST_SHOWN]:
        again = f"python -m tools.torture {each['name']} --case {defect['seed']}"
        lines.append(
            f"- {defect['kind']}, {defect['group']}: {_plain(defect['detail'])} (`{again}`)"
        )
    if len(defects) > MOST_SHOWN:
        lines.append(f"- and {len(defects) - MOST_SHOWN} more")
    return [*lines, ""] if defects else lines


def _plain(text: str) -> str:
    text = re.sub(r"/\S*torture-[\w-]+/(case/)?", "", text)  # folders of a case, gone since
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")[:300]
