"""Other simulated episodes: a slender arm of six joints, a wrist camera, two other tasks.

No limit of `cdmisfa episodes` was set on them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benchmarks.robot_episodes import World

# Axis of each joint, length and radius of the link that it moves (m), and its color.
_LINKS = [
    ("0 0 1", 0.26, 0.055, "0.9 0.9 0.88"), ("0 1 0", 0.32, 0.04, "0.9 0.45 0.1"),
    ("0 1 0", 0.28, 0.034, "0.9 0.9 0.88"), ("0 0 1", 0.06, 0.032, "0.15 0.15 0.17"),
    ("0 1 0", 0.06, 0.03, "0.9 0.45 0.1"), ("0 0 1", 0.1, 0.016, "0.15 0.15 0.17"),
]  # fmt: skip

_LINK = """<link name="l{k}">
<inertial><origin xyz="0 0 {half}"/><mass value="0.5"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0 0 {half}"/><material name="m{k}"><color rgba="{color} 1"/></material>
<geometry><cylinder radius="{radius}" length="{length}"/></geometry></visual></link>
<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>
<origin xyz="0 0 {offset}"/><axis xyz="{axis}"/>
<limit lower="-3.1" upper="3.1" effort="300" velocity="10"/></joint>"""


def arm_urdf() -> str:
    """Return the arm as URDF: links of cylinders, and a tip at the end of the last."""
    parts, parent, offset = [], "base", 0.0
    for k, (axis, length, radius, color) in enumerate(_LINKS):
        words = {"axis": axis, "length": length, "radius": radius, "color": color}
        parts.append(_LINK.format(k=k, half=length / 2, parent=parent, offset=offset, **words))
        parent, offset = f"l{k}", length
    end = f'<joint name="end" type="fixed"><parent link="{parent}"/><child link="tip"/>'
    end += f'<origin xyz="0 0 {offset}"/></joint><link name="tip"/>'
    return f'<robot name="bench"><link name="base"/>{"".join(parts)}{end}</robot>'


class Bench(World):
    """A bench with a slender arm, seen from the side and from its wrist."""

    tasks: ClassVar[tuple[str, ...]] = ("stir", "shelf")
    cameras: ClassVar[tuple[str, str]] = ("side", "wrist")
    home: ClassVar[Sequence[float]] = (0, 0.2, 1.6, 0, 1.34, 0)

    def _urdf(self) -> str:
        file = Path(tempfile.mkdtemp()) / "bench.urdf"
        file.write_text(arm_urdf())
        return str(file)

    def _scene(self) -> None:
        self._box([0.6, 0.7, 0.02], [0.35, 0, -0.02], [0.45, 0.5, 0.46])
        self._box([2, 2, 0.02], [0, 0, -0.8], [0.5, 0.42, 0.36])
        self._box([2, 0.02, 1], [0.3, -0.9, 0.3], [0.7, 0.68, 0.6])
        self._box([0.05, 0.05, 0.09], [0.62, -0.35, 0.09], [0.6, 0.55, 0.15])
        self._box([0.09, 0.06, 0.03], [0.12, -0.42, 0.03], [0.2, 0.45, 0.4])
        if self.task == "shelf":
            self._box([0.12, 0.12, 0.01], [0.42, 0.28, 0.16], [0.35, 0.25, 0.2])
            self._box([0.12, 0.01, 0.08], [0.42, 0.39, 0.08], [0.35, 0.25, 0.2])

    def _eyes(self) -> list[tuple[Any, Any, Any]]:
        place, turned = self.p.getLinkState(self.arm, self.tip)[:2]
        frame = np.reshape(self.p.getMatrixFromQuaternion(turned), (3, 3))
        eye = place + frame @ [0.11, 0, -0.14]
        return [([0.5, 1.05, 0.7], [0.33, 0, 0.16], [0, 0, 1]),
                (eye, place + frame @ [0, 0, 0.06], frame @ [1, 0, 0])]  # fmt: skip

    def _plan(self, rng: np.random.Generator, fault: str, start: np.ndarray) -> Any:
        wrong, missing = fault == "object", fault == "object" and rng.random() < 0.4
        up, self.things, carried = np.array([0, 0, 1.0]), [], None
        a = np.array([rng.uniform(0.34, 0.5), rng.uniform(-0.22, 0), 0.0])
        miss = rng.choice([-1, 1]) * np.array([0, rng.uniform(0.1, 0.15), 0]) * (fault == "fail")
        if self.task == "stir":
            walls = [
                ([0.075, 0.005, 0.03], [0, 0.075, 0.03]),
                ([0.005, 0.075, 0.03], [0.075, 0, 0.03]),
            ]
            for half, place in walls:
                for side in (-1, 1):
                    at = a + np.array(place) * [side, side, 1]
                    self.things.append(self._box(half, at, [0.85, 0.85, 0.9]))
            if not missing:
                food = [0.25, 0.3, 0.75] if wrong else [0.85, 0.6, 0.2]
                self.things.append(self._box([0.07, 0.07, 0.012], a + up * 0.012, food))
            angles = np.arange(rng.integers(24, 40)) * np.pi / 5 + rng.uniform(0, 2 * np.pi)
            turns = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
            ring = a + miss + up * 0.05 + rng.uniform(0.03, 0.045) * turns
            plan = [(ring[0] + up * 0.15, 0, 1.1), (ring[0], 0, 0.7), *((r, 0, 0.16) for r in ring)]
            plan += [(ring[-1] + up * 0.14, 0, 0.6), (start, 0, 0.9)]
        else:
            if not missing:
                color = [0.75, 0.7, 0.7] if wrong else [0.15, 0.65, 0.25]
                carried = self._box([0.025, 0.025, 0.045], a + up * 0.045, color, 0.05)
                self.things.append(carried)
            grip = a + up * 0.12 + miss
            drop = np.array([0.42 + rng.uniform(-0.05, 0.05), 0.27, 0.29])
            plan = [(grip + up * 0.1, 0, 1.0), (grip, 0, 0.7), (grip, 1, 0.3),
                    (grip + up * 0.2, 1, 0.9), (drop + up * 0.1, 1, 1.3), (drop, 1, 0.5),
                    (drop, 0, 0.3), (drop + up * 0.1, 0, 0.5), (start, 0, 1.1)]  # fmt: skip
        return plan, carried
