"""What all cases came to: a document, a page, a few lines."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from .campaigns import CAMPAIGNS, campaign
from .outcomes import DEFECTS, GOOD, HELD

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
        "schema": 2,
        "hours": round(sum(seconds.values()) / 3600, 1),
        "runs": [line["run"] for line in lines if "run" in line],
        "campaigns": [
            {
                "name": name,
                "cases": sum(sum(c.values()) for (of, _), c in counts.items() if of == name),
                "mended": CAMPAIGNS[name],
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
    runs, defects = found["runs"], found["defects"]
    rows, all_tried = [], 0
    for each in found["campaigns"]:
        about = (campaign(each["name"]).__doc__ or "").strip().partition("\n\n")[0]
        kinds = _totals(each)
        held = sum(kinds[kind] for kind in HELD)
        tried = held + sum(kinds[kind] for kind in DEFECTS)
        told = [each["name"], _plain(about), tried, held, each["mended"]]
        rows.append(f"| {' | '.join(map(str, told))} |")
        all_tried += tried
    lines = [
        "# What was done to it, and what held",
        "",
        f"Made by `make torture` at commit {_distinct(runs, 'commit')}: {all_tried} cases in "
        f"{found['hours']} hours of work, of the first seed {_distinct(runs, 'seed')}; "
        f"Python {_distinct(runs, 'python')}, {_distinct(runs, 'platform')}.",
        f"[{data}]({data}) counts the commands, the moments and the kinds of damage apart.",
        "",
        "- **tried**: cases; what this machine cannot do, or was over before, is not among them",
        "- **held**: the right bits, or one clear line in time where there can be none",
        "- **mended**: faults that the campaign has found in all its runs, each with a test now",
        "",
        "| campaign | what is done | tried | held | mended |",
        "|---|---|---:|---:|---:|",
        *rows,
        "",
    ]
    lines += ["What did not hold, and the command that does it again:", ""] if defects else []
    for defect in defects[:MOST_SHOWN]:
        again = f"python -m tools.torture {defect['campaign']} --case {defect['seed']}"
        what = f"{defect['kind']}, {defect['campaign']}, {defect['group']}"
        lines.append(f"- {what}: {_plain(defect['detail'])} (`{again}`)")
    if len(defects) > MOST_SHOWN:
        lines.append(f"- and {len(defects) - MOST_SHOWN} more")
    return "\n".join([*lines, ""] if defects else lines)


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
