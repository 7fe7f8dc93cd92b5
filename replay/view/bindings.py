"""Every name of Rerun that it does not promise to keep, and what to do when one goes.

`rerun_bindings` lies below Rerun's package: it loads in 10 ms, the package in half a second,
which a table of runs does not need. Nothing else of ours takes a private name from Rerun.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import rerun_cli

# A client of the catalogue server without DataFusion. Instead: `rerun.catalog.CatalogClient`.
from rerun_bindings import CatalogClientInternal as CatalogueClient

# Properties of a run without the package. Instead: `rerun.chunk.Chunk` and its store.
from rerun_bindings import ChunkInternal as Chunk
from rerun_bindings import ChunkStoreInternal as ChunkStore

# The same class as `rerun.ComponentDescriptor`, without the package.
# The same function as `rerun.escape_entity_path_part`, without the package.
from rerun_bindings import ComponentDescriptor, escape_entity_path_part

# Reads and filters a view without the package. Instead: `rerun.chunk.RrdReader`.
from rerun_bindings import RrdReaderInternal as RrdReader

__all__ = [
    "CatalogueClient",
    "Chunk",
    "ChunkStore",
    "ComponentDescriptor",
    "RrdReader",
    "escape_entity_path_part",
    "viewer_client",
    "viewer_program",
]


def viewer_client() -> Any:
    """The class that steers a running viewer and takes its picture.

    It is experimental, and may move to another module. Without it there are no screenshots.
    """
    from rerun.experimental import ViewerClient

    return ViewerClient


def viewer_program() -> Path:
    """The viewer itself; the `rerun` on the path is a wrapper that leaves it behind when ended.

    It lies beside `rerun_cli`. If it moves, the wrapper serves as well, but for that.
    """
    return Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")
