"""The page of all results, made from the results files so that it cannot drift."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.untrusted.memory import MAX_LIST
from cdmisfa.core.untrusted.regular import read_json
from cdmisfa.paper.reproduce import NAMES, markdown_table


def write_page(root: Path, page: Path) -> None:
    """Write a Markdown page of every experiment below a folder.

    Its figures go into a folder of the page's name next to it.

    Raises:
        UsageError: there is no result below the folder, or one cannot be read.
    """
    documents = [
        read_results(root / name) for name in NAMES if (root / name / "results.json").exists()
    ]
    if not documents:
        raise UsageError(f"{root} has no results: run cdmisfa reproduce all -o {root} first")
    figures = page.with_suffix("")
    figures.mkdir(parents=True, exist_ok=True)
    parts = [
        "# The paper, reproduced",
        "",
        "Made by `cdmisfa reproduce --page`; do not edit. Numbers are means over trials; SD is the",
        "standard deviation, n the number of trials. The paper's values are those that its tables",
        "print; (text) marks what its text says, (equation) what follows from its equations,",
        "(figure) what was read from a figure. Where the paper leaves something open, the readings",
        "are in [decisions](decisions/).",
    ]
    for document in documents:
        name = document["experiment"]
        parts += ["", f"## {document['title']}", ""]
        command = f"cdmisfa reproduce {name}{' --quick' if document['quick'] else ''}"
        parts += [f"`{command}`, {document['trials']} trials.", ""]
        parts += [
            f"- {'Yes' if c['holds'] else '**No**'}: {c['claim']} ({c['detail']})"
            for c in document["claims"]
        ]
        parts += ["", markdown_table(document["table"]).rstrip(), ""]
        parts += [f"{note}\n" for note in document["notes"]]
        for figure in document["figures"]:
            if figure.endswith(".png"):
                shutil.copyfile(root / name / figure, figures / figure)
                parts += [f"![{document['title']}]({figures.name}/{figure})", ""]
    versions = sorted(documents[0]["versions"].items())
    parts += ["", f"Versions: {', '.join(map(' '.join, versions))}.", ""]
    page.write_text("\n".join(parts), encoding="utf-8")


def read_results(folder: Path) -> dict[str, Any]:
    """The results.json of an experiment.

    Raises:
        UsageError: it cannot be read.
    """
    path = folder / "results.json"
    try:
        document = read_json(path, "run it again", most=MAX_LIST)
        if document["schema"] != 1:
            raise ValueError(document["schema"])
    except (CdmisfaError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{path} cannot be read: run cdmisfa reproduce {folder.name} again"
        ) from error
    return dict(document)
