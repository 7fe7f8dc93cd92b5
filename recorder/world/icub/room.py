"""What stands in the furnished room, by `room.toml`, and how the objects on the table look."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

from cdmisfa.core.arrays import ByteArray
from recorder.world.icub.config import TABLE_FROM, TABLE_TO, IcubConfig
from recorder.world.icub.meshes import PERIOD, Mesh, ball_mesh, box_mesh, can_mesh
from recorder.world.icub.textures import texture

Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Piece:
    """A body to be drawn.

    Attributes:
        mesh: around its own origin.
        centre: where that is, root frame.
        colour: where it has no paint.
        paint: its texture.
        gloss: share of the light that is mirrored.
        casts: it casts a shadow.
    """

    mesh: Mesh
    centre: Place = (0.0, 0.0, 0.0)
    colour: Place = (1.0, 1.0, 1.0)
    paint: ByteArray | None = None
    gloss: float = 0.0
    casts: bool = True


@dataclass(frozen=True, slots=True)
class Room:
    """Everything that is drawn but the robot.

    Attributes:
        pieces: what stands still, the table's top first.
        objects: the box, the cylinder and the ball, as `World.place` moves them.
    """

    pieces: tuple[Piece, ...]
    objects: tuple[Piece, ...]


def room_of(scene: IcubConfig) -> Room:
    """The room of a scene; where it has none, the table that fills every image."""
    told = _document()
    top, thickness = scene.table.top, scene.table.thickness
    if scene.room:
        low, high = (*TABLE_FROM, top - thickness), (*TABLE_TO, top)
    else:
        side = scene.table.half_size
        low, high = (-side, -side, top - thickness), (side, side, top)
    table = {**told["table"], "from": low, "to": high}
    if not scene.texture:
        table["colour"] = scene.table.colour
    pieces = [table, *(_legs(told["legs"], low, high) if scene.room else ())]
    pieces += told["piece"] if scene.room else []
    return Room(
        tuple(_box(piece, textured=scene.texture) for piece in pieces),
        _objects(scene, told["objects"]),
    )


@cache
def _document() -> dict[str, Any]:
    text = resources.files("recorder.world.icub").joinpath("room.toml").read_text("utf-8")
    return tomllib.loads(text)


def painted(name: str) -> Place:
    """The colour of the table or of an object, "box", "cylinder" or "ball", with its paint."""
    told = _document()
    place: Place = tuple((told["table"] if name == "table" else told["objects"][name])["colour"])
    return place


def _legs(legs: Mapping[str, Any], low: Place, high: Place) -> list[dict[str, Any]]:
    """The table's four legs, from the floor to its top."""
    half, inset = legs["half"], legs["inset"]
    floor = next(piece for piece in _document()["piece"] if piece["name"] == "floor")["to"][2]
    return [
        {**legs, "from": (x - half, y - half, floor), "to": (x + half, y + half, low[2])}
        for x in (low[0] + inset, high[0] - inset)
        for y in (low[1] + inset, high[1] - inset)
    ]


def _box(piece: Mapping[str, Any], *, textured: bool) -> Piece:
    low, high = piece["from"], piece["to"]
    x, y, z = ((a + b) / 2 for a, b in zip(low, high, strict=True))
    half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
    mesh = box_mesh(half, piece.get("along", "y"), PERIOD)
    paint = _paint(piece) if textured else None
    return Piece(mesh, (x, y, z), tuple(piece["colour"]), paint, casts=piece.get("casts", True))


def _objects(scene: IcubConfig, told: Mapping[str, Any]) -> tuple[Piece, ...]:
    box, cylinder, ball = scene.object1, scene.object2, scene.object3
    shapes = (
        ("box", box_mesh((box.half_size,) * 3, period=0.0), box.grey),
        ("cylinder", can_mesh(cylinder.radius, cylinder.height), cylinder.grey),
        ("ball", ball_mesh(ball.radius), ball.grey),
    )
    if scene.physics:  # stripes that roll would hide how slowly the ball moves
        told = {**told, "ball": {**told["ball"], "texture": "plaster", "count": 6}}
    return tuple(
        Piece(
            mesh,
            colour=(grey,) * 3,
            paint=_paint(told[name]) if scene.texture else None,
            gloss=0.2 if scene.texture else 0.0,
        )
        for name, mesh, grey in shapes
    )


def _paint(piece: Mapping[str, Any]) -> ByteArray | None:
    """A piece's texture, if it has one."""
    if "texture" not in piece:
        return None
    return texture(piece["texture"], tuple(piece["colour"]), piece["count"])
