"""What a bundle says of itself: the description of an RO-Crate, as JSON-LD."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path, PurePath
from typing import Any, Final
from urllib.parse import quote

from cdmisfa.core.errors import UsageError
from cdmisfa.core.names import counted
from cdmisfa.experiments.reports import command_again
from replay.runs.folders import RUN_JSON, read_run_json
from replay.storage.packed import Packed

METADATA: Final = "ro-crate-metadata.json"
"""Name of the file that describes an RO-Crate."""

CRATE: Final = "https://w3id.org/ro/crate/1.1"
PROFILE: Final = "https://w3id.org/ro/wfrun/process/0.5"
"""What a bundle conforms to: the specification of RO-Crate, and its profile of what was run."""

RUN, SOURCE = "run/", "source/"
"""Folders of a bundle: of the run, and of what it learned from."""

TITLE: Final = "cdmisfa: record, learn and replay modular slow features"
AUTHOR: Final = "The maintainers of cdmisfa"
PAPER: Final = "https://arxiv.org/abs/1701.04663"
"""What CITATION.cff says of this program, and the paper whose learner it is."""

_CONTEXT: Final = [f"{CRATE}/context", {"sha256": "http://schema.org/sha256"}]
LEARNED: Final = "#learn"
_JSON, _BYTES = "application/json", "application/octet-stream"
_UNSTATED: Final = "Not stated: ask who made it."

Entity = dict[str, Any]


@dataclass(frozen=True, slots=True)
class About:
    """What a bundle says of itself, as its author tells it.

    Attributes:
        license: a name of SPDX, a URL or words; "" grants none.
        authors: their names.
        date: of publication, as YYYY-MM-DD; "" is the day on which the run ended.
    """

    license: str = ""
    authors: tuple[str, ...] = ()
    date: str = ""


def description(
    run: Path, files: Sequence[Packed], words: Sequence[str], about: About
) -> Mapping[str, Any]:
    """The JSON-LD document of a bundle."""
    document = read_run_json(run)
    versions, result = document.get("versions", {}), document["result"]
    when = about.date or datetime.fromtimestamp((run / RUN_JSON).stat().st_mtime, UTC).date()
    people = [_entity(f"#author/{quote(name)}", "Person", name) for name in about.authors]
    maker = _entity("#maintainers", "Organization", AUTHOR)
    settings = [
        _entity(f"#{section}.{key}", "PropertyValue", f"{section}.{key}", value=_shown(value))
        for section, table in sorted(document["config"].items())
        for key, value in sorted(table.items())
    ]
    settings.append(_entity("#seed", "PropertyValue", "seed", value=document["seed"]))
    folders = [
        _entity(quote(word), "Dataset", word, hasPart=_refs(_entities(files, word)))
        for word in words
        if word.endswith("/")
    ]
    listed = _entities(files)
    beside = [] if words else _stated(document["source"])
    came = (
        f"{counted(result['iterations'], 'iteration')}, {counted(len(result['modules']), 'module')}"
        f", signals SHA-256 {result['signals_sha256']}."
    )
    license_ = _license(about.license)
    root = _entity(
        "./",
        "Dataset",
        f"{run.resolve().name}: a run of cdmisfa",
        description=f"{came} cdmisfa check learns it again and compares every signal bit for bit.",
        datePublished=_day(str(when)),
        license=_ref(license_) if license_ else about.license or _UNSTATED,
        conformsTo={"@id": PROFILE},
        mentions={"@id": LEARNED},
        hasPart=_refs([*listed, *folders]),
        **({"author": _refs(people)} if people else {}),
    )
    learned = _entity(
        LEARNED,
        "CreateAction",
        "cdmisfa learn",
        description=command_again(run, words or _names(document.get("command", {}))),
        instrument={"@id": "#cdmisfa"},
        object=[*({"@id": quote(word)} for word in words), *map(_ref, [*beside, *settings])],
        result=_refs(_entities(files, RUN)),
        actionStatus="http://schema.org/CompletedActionStatus",
        **({"agent": _refs(people)} if people else {}),
    )
    program = _entity(
        "#cdmisfa",
        "SoftwareApplication",
        TITLE,
        softwareVersion=versions.get("cdmisfa", "unknown"),
        license="Apache-2.0",
        author=_ref(maker),
        citation={"@id": PAPER},
        softwareRequirements=[f"{name} {it}" for name, it in versions.items() if name != "cdmisfa"],
    )
    paper = _entity(PAPER, "ScholarlyArticle", "The paper whose learner it is")
    head = {
        "@id": METADATA,
        "@type": "CreativeWork",
        "conformsTo": {"@id": CRATE},
        "about": {"@id": "./"},
    }
    profile = _entity(PROFILE, "CreativeWork", "Process Run Crate", version="0.5")
    graph = [head, root, profile, learned, program, maker, paper, *people]
    graph += [*([license_] if license_ else []), *folders, *listed, *beside, *settings]
    return {"@context": _CONTEXT, "@graph": graph}


def _entity(id_: str, kind: str, name: str, **more: Any) -> Entity:
    return {"@id": id_, "@type": kind, "name": name, **more}


def _entities(files: Sequence[Packed], below: str = "") -> list[Entity]:
    """The files whose name begins so, as entities."""
    return [
        _entity(
            quote(file.name),
            "File",
            file.name.rpartition("/")[2],
            contentSize=str(file.size),
            encodingFormat=_JSON if file.name.endswith(".json") else _BYTES,
            sha256=file.sha256,
        )
        for file in files
        if file.name.startswith(below)
    ]


def _names(command: Mapping[str, Any]) -> list[str]:
    """The source of a command without the folders that paths lie in."""
    words = [str(word) for word in command.get("source", ())]
    return [word if "://" in word else PurePath(word).name for word in words]


def _stated(source: Mapping[str, Any]) -> list[Entity]:
    """The files of a source that is not included, as the run states them."""
    files = [file for key in ("files", "views") for file in source.get(key, ())]
    return [
        _entity(
            f"#{SOURCE}{number}/{quote(str(file.get('file')))}",
            "CreativeWork",
            str(file.get("url", file.get("file"))),
            **({"contentSize": str(file["bytes"])} if "bytes" in file else {}),
            **({"sha256": file["sha256"]} if "sha256" in file else {}),
        )
        for number, file in enumerate(files)
    ]


def _license(said: str) -> Entity | None:
    """A licence that has an address, as an entity."""
    if "://" in said:
        return _entity(said, "CreativeWork", said)
    if said and " " not in said:
        return _entity(f"https://spdx.org/licenses/{quote(said)}", "CreativeWork", said)
    return None


def _day(said: str) -> str:
    try:
        return date.fromisoformat(said).isoformat()
    except ValueError:
        raise UsageError(f"{said!r} is no day: write it as 2026-01-31") from None


def _ref(entity: Entity) -> Entity:
    return {"@id": entity["@id"]}


def _refs(entities: Sequence[Entity]) -> Entity | list[Entity]:
    """References to entities; to one alone it is no list, as the specification wants it."""
    refs = [_ref(entity) for entity in entities]
    return refs if len(refs) != 1 else refs[0]


def _shown(value: Any) -> Any:
    """A value of a configuration as one of JSON-LD, which knows no lists of lists."""
    return value if isinstance(value, bool | int | float | str) else str(value)
