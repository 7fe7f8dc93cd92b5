"""What all cases came to: a document, a page, a few lines."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from .campaigns import CAMPAIGNS, campaign
from .outcomes import DEFECTS, GOOD, MEANING

MOST_SHOWN = 20
"""Defects that are told one by one."""


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
        "hours": round(sum(seconds.values()) / 3600, 1),
        "runs": [line["run"] for line in lines if "run" in line],
        "campaigns": [
            {
                "name": name,
                "cases": sum(sum(c.values()) for (of, _), c in counts.items() if of == name),
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
        kinds = _totals(each)
        told = ", ".join(f"{kinds[kind]} {kind}" for kind in (*GOOD, *DEFECTS) if kinds[kind])
        rows.append(f"{each['name']}: {each['cases']} cases: {told}")
    return "\n".join([*rows, f"{len(found['defects'])} defects"])


def markdown(found: dict[str, Any], data: str) -> str:
    """The page: a row for each campaign; its groups are in the file `data` beside it."""
    cases = sum(each["cases"] for each in found["campaigns"])
    runs, defects = found["runs"], found["defects"]
    totals = {each["name"]: _totals(each) for each in found["campaigns"]}
    kinds = [k for k in (*GOOD, *DEFECTS) if k in GOOD[:2] or any(k in c for c in totals.values())]
    lines = [
        "# What was done to it, and what came of that",
        "",
        "Made by `make torture`, then `python -m tools.torture --minutes 0 --page "
        "docs/reliability.md`;",
        "figures are of the runs named here, failures included.",
        "",
        f"{cases} cases in {found['hours']} hours of work, {len(defects)} defects. "
        f"Commit {_distinct(runs, 'commit')}; Python {_distinct(runs, 'python')}; "
        f"{_distinct(runs, 'platform')}; first seeds {_distinct(runs, 'seed')}.",
        f"[{data}]({data}) counts the commands and the kinds of damage apart.",
        "",
        *(f"- **{kind}**: {MEANING[kind]}" for kind in kinds),
        "",
        f"| campaign | | cases | {' | '.join(kinds)} | MB of one process |",
        f"|---|---|{'---:|' * (len(kinds) + 2)}",
    ]
    for each in found["campaigns"]:
        about = (campaign(each["name"]).__doc__ or "").strip().partition("\n\n")[0]
        counts = " | ".join(str(totals[each["name"]][kind]) for kind in kinds)
        told = [each["name"], _plain(about), each["cases"], counts, each["peak_megabytes"]]
        lines.append(f"| {' | '.join(map(str, told))} |")
    lines += ["", "## Defects", "", "As they were found; the command repeats a case today.", ""]
    for defect in defects[:MOST_SHOWN]:
        again = f"python -m tools.torture {defect['campaign']} --case {defect['seed']}"
        what = f"{defect['kind']}, {defect['campaign']}, {defect['group']}"
        lines.append(f"- {what}: {_plain(defect['detail'])} (`{again}`)")
    if len(defects) > MOST_SHOWN:
        lines.append(f"- and {len(defects) - MOST_SHOWN} more")
    return "\n".join([*lines, ""])


def _totals(each: dict[str, Any]) -> Counter[str]:
    kinds: Counter[str] = Counter()
    for group in each["groups"]:
        kinds.update({k: n for k, n in group.items() if k != "group"})
    return kinds


def _distinct(runs: Sequence[dict[str, Any]], key: str) -> str:
    return ", ".join(dict.fromkeys(str(run[key]) for run in runs))


def _plain(text: str) -> str:
    text = re.sub(r"/\S*torture-[\w-]+/(case/)?", "", text)  # folders of a case, gone since
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")[:300]
