"""Meshes and textures of the furnished room, which `room.toml` describes, and of its objects.

Meshes have few triangles. They show a texture completely; Bullet's own shapes show a quarter of it.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from cdmisfa.core.arrays import ByteArray
from recorder.world.icub.config import TABLE_FROM, TABLE_TO, IcubConfig
from recorder.world.icub.textures import texture

# Length after which the texture of a box repeats (m). Set by hand, like the other values here.
PERIOD = 1.6

# Number of corners of a circle: few, so that drawing is fast.
AROUND = 16

# Steps of the last digit to try in x, y and z, the smallest first; see `steady`.
_STEPS = np.array(
    sorted(itertools.product(range(-3, 4), repeat=3), key=lambda steps: sum(map(abs, steps))),
    np.float32,
)


@dataclass(slots=True)
class Mesh:
    """Mesh of triangles, in the arguments of Bullet's `createVisualShape`."""

    vertices: list[list[float]] = field(default_factory=list)
    normals: list[list[float]] = field(default_factory=list)
    uvs: list[list[float]] = field(default_factory=list)
    indices: list[int] = field(default_factory=list)


def box_mesh(half: Sequence[float], along: str = "y", period: float = PERIOD) -> Mesh:
    """Return a box around the origin, with the fibres of its texture along an axis.

    Args:
        half: half the lengths of its sides (m).
        along: axis of the fibres, "x", "y" or "z".
        period: size of a texture (m); 0: one texture on each side.
    """
    mesh, fibres = Mesh(), "xyz".index(along)
    for axis in range(3):
        u, v = sorted({0, 1, 2} - {axis}, key=lambda i: (i == fibres, i))
        for side in (-1, 1):
            first = len(mesh.vertices)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner, normal = [0.0] * 3, [0.0] * 3
                corner[axis], corner[u], corner[v] = side * half[axis], a * half[u], b * half[v]
                normal[axis] = float(side)
                mesh.vertices.append(corner)
                mesh.normals.append(normal)
                size = (period / 2 / half[u], period / 2 / half[v]) if period else (1, 1)
                mesh.uvs.append([(a + 1) / 2 / size[0], (b + 1) / 2 / size[1]])
            # The corners are counterclockwise from outside.
            straight = side * (1 if (v - u) % 3 == 1 else -1) > 0
            turns = (0, 1, 2, 0, 2, 3) if straight else (0, 2, 1, 0, 3, 2)
            mesh.indices += [first + i for i in turns]
    return mesh


def round_mesh(rings: Sequence[tuple[float, float, float, float, float]]) -> Mesh:
    """Return a body of revolution around z with one texture around it.

    Args:
        rings: from the bottom up, radius, height, the normal's outward and upward components, and
            the position in the texture.
    """
    mesh = Mesh()
    for i, (radius, height, out, up, v) in enumerate(rings):
        for j in range(AROUND + 1):
            turn = 2 * math.pi * (j % AROUND) / AROUND
            c, s = round(math.cos(turn), 9), round(math.sin(turn), 9)
            mesh.vertices.append([radius * c, radius * s, height])
            mesh.normals.append(steady((out * c, out * s, up)))
            mesh.uvs.append([j / AROUND, v])
            if i and j:
                a = i * (AROUND + 1) + j
                b = a - AROUND - 1
                mesh.indices += [b - 1, b, a, b - 1, a, a - 1]
    return mesh


def steady(normal: Sequence[float]) -> list[float]:
    """Return a float32 vector near a unit normal that normalising does not change.

    Bullet's renderer normalises in place each time that it draws a corner. Other normals change by
    a last digit each time, so that images would depend on how often a body was drawn before.
    """
    near = np.asarray(normal, np.float32)
    for steps in _STEPS:
        normal32 = near + np.spacing(near) * steps * (near != 0)
        x, y, z = normal32 * normal32
        if x + y + z == x + z + y == y + z + x == 1:
            return [float(part) for part in normal32]
    raise ValueError(f"{normal} is not a unit normal")


def can_mesh(radius: float, height: float) -> Mesh:
    """Return a can: its side and its lid, because the bottom is never visible."""
    half = height / 2
    side = [(radius, -half, 1.0, 0.0, 0.0), (radius, half, 1.0, 0.0, 0.9)]
    return round_mesh([*side, (radius, half, 0.0, 1.0, 0.95), (0.0, half, 0.0, 1.0, 1.0)])


def ball_mesh(radius: float) -> Mesh:
    """Return a ball of eight rings."""
    turns = [math.pi * (i / 8 - 0.5) for i in range(9)]
    sides = [(round(math.cos(turn), 9), round(math.sin(turn), 9)) for turn in turns]
    return round_mesh([(radius * c, radius * s, c, s, i / 8) for i, (c, s) in enumerate(sides)])


Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Piece:
    """A body of the room.

    Attributes:
        mesh: mesh around its own origin.
        centre: position of that origin in the root frame (m).
        colour: color without a texture.
        paint: texture, or None.
        gloss: share of mirrored light.
        casts: True if it casts a shadow.
    """

    mesh: Mesh
    centre: Place = (0.0, 0.0, 0.0)
    colour: Place = (1.0, 1.0, 1.0)
    paint: ByteArray | None = None
    gloss: float = 0.0
    casts: bool = True


@dataclass(frozen=True, slots=True)
class Room:
    """All bodies except the robot.

    Attributes:
        pieces: bodies that never move, the table's top first.
        objects: the box, the cylinder and the ball, as `World.place` moves them.
    """

    pieces: tuple[Piece, ...]
    objects: tuple[Piece, ...]


def room_of(scene: IcubConfig) -> Room:
    """Return the room of a scene; a plain scene has only a table that fills every image."""
    document = _document()
    top, thickness = scene.table.top, scene.table.thickness
    if scene.room:
        low, high = (*TABLE_FROM, top - thickness), (*TABLE_TO, top)
    else:
        side = scene.table.half_size
        low, high = (-side, -side, top - thickness), (side, side, top)
    table = {**document["table"], "from": low, "to": high}
    if not scene.texture:
        table["colour"] = scene.table.colour
    pieces = [table, *(_legs(document["legs"], low, high) if scene.room else ())]
    pieces += document["piece"] if scene.room else []
    boxes = tuple(_box(piece, textured=scene.texture) for piece in pieces)
    return Room(boxes, _objects(scene, document["objects"]))


@cache
def _document() -> dict[str, Any]:
    text = resources.files("recorder.world.icub").joinpath("room.toml").read_text("utf-8")
    return tomllib.loads(text)


def painted(name: str) -> Place:
    """Return the color of the textured "table", "box", "cylinder" or "ball"."""
    document = _document()
    red, green, blue = {"table": document["table"], **document["objects"]}[name]["colour"]
    return red, green, blue


def _legs(legs: Mapping[str, Any], low: Place, high: Place) -> list[dict[str, Any]]:
    """Return the table's four legs, from the floor to its top."""
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


def _objects(scene: IcubConfig, looks: Mapping[str, Any]) -> tuple[Piece, ...]:
    box, cylinder, ball = scene.object1, scene.object2, scene.object3
    shapes = (
        ("box", box_mesh((box.half_size,) * 3, period=0.0), box.grey),
        ("cylinder", can_mesh(cylinder.radius, cylinder.height), cylinder.grey),
        ("ball", ball_mesh(ball.radius), ball.grey),
    )
    if scene.physics:  # no stripes: while they roll, the image changes fast, however slow the ball
        looks = {**looks, "ball": {**looks["ball"], "texture": "plaster", "count": 6}}
    return tuple(
        Piece(
            mesh,
            colour=(grey,) * 3,
            paint=_paint(looks[name]) if scene.texture else None,
            gloss=0.2 if scene.texture else 0.0,
        )
        for name, mesh, grey in shapes
    )


def _paint(piece: Mapping[str, Any]) -> ByteArray | None:
    """Return a piece's texture, if it has one."""
    if "texture" not in piece:
        return None
    return texture(piece["texture"], tuple(piece["colour"]), piece["count"])
