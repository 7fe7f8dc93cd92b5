"""The scenes there are, opened by name; others are added by `SCENES.add` and by plugins."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from cdmisfa.core.blocks import FrameSource, SeekableSource
from cdmisfa.core.config import as_table
from cdmisfa.core.errors import UsageError
from cdmisfa.core.registry import Registry
from recorder.config import RecordConfig, SceneConfig
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.picture import scene_picture
from recorder.world.icub.source import IcubSource
from recorder.world.oscillatory import OscillatoryConfig, OscillatorySource

if TYPE_CHECKING:
    from PIL.Image import Image


Opener = Callable[[Any, RecordConfig], SeekableSource]
"""Makes a scene's source from its configuration and the clock of the frames.

Only a function that can be imported can also open it in other processes.
"""


@dataclass(frozen=True, slots=True)
class Scene:
    """A simulated world: everything that the rest knows of it.

    Attributes:
        config: what it can be told (keys `scene.*`).
        open: makes its source.
        preset: its configuration where none is chosen: name of a preset, or a .toml file.
        picture: draws it from outside, where that can be done.
        packages: whose versions its frames depend on.
    """

    config: type[SceneConfig]
    open: Opener
    preset: str
    picture: Callable[[Any], Image] | None = None
    packages: tuple[str, ...] = ()


def _open_oscillatory(config: OscillatoryConfig, record: RecordConfig) -> SeekableSource:
    return OscillatorySource(config.streams, fps=record.fps, start_ns=record.start_ns)


SCENES: Registry[Scene] = Registry(
    "scene",
    {
        "icub": Scene(IcubConfig, IcubSource, "icub", scene_picture, ("pybullet", "icub-models")),
        "oscillatory": Scene(OscillatoryConfig, _open_oscillatory, "oscillatory"),
    },
    group="cdmisfa.sources",
)
"""The live scenes; `SCENES.add` and entry points `cdmisfa.sources` add others."""


@dataclass(frozen=True, slots=True)
class OpenScene:
    """What a scene's source was opened from.

    Attributes:
        name: of the scene.
        config: its configuration, with a seed.
        record: the clock of the frames.
    """

    name: str
    config: SceneConfig
    record: RecordConfig

    def table(self) -> dict[str, Any]:
        """The scene's configuration as recordings state it.

        Those of the first two scenes state the keys of both, so that they stay the same bytes.
        """
        first = (IcubConfig, OscillatoryConfig)
        tables = [as_table(config()) for config in first] if type(self.config) in first else []
        return {key: v for table in (*tables, as_table(self.config)) for key, v in table.items()}


_OPEN: dict[int, OpenScene] = {}


def open_scene(
    name: str, config: SceneConfig | None = None, record: RecordConfig | None = None
) -> SeekableSource:
    """A live source of a scene's streams.

    Args:
        name: one of `SCENES`.
        config: of the scene; by default the preset's, with seed 0.
        record: the clock of the frames.

    Raises:
        UsageError: no such scene, the configuration of another, or one that cannot be built.
        CdmisfaError: the scene needs a simulator that is not installed.
    """
    kind = SCENES[name].config
    config = config if config is not None else kind()
    if not isinstance(config, kind):
        raise UsageError(f"the scene {name} takes {kind.__name__}, not {type(config).__name__}")
    scene = OpenScene(name, replace(config, seed=config.seed or 0), record or RecordConfig())
    source = SCENES[name].open(scene.config, scene.record)
    with contextlib.suppress(TypeError):  # a class without weak references
        weakref.finalize(source, _OPEN.pop, id(source), None)
        _OPEN[id(source)] = scene
    return source


def scene_of(source: FrameSource) -> OpenScene | None:
    """What `open_scene` opened a source from; None for any other source."""
    return _OPEN.get(id(source))
