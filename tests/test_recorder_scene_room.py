"""The furnished iCub scene: what is seen, which bytes, and that the plain one is as it was."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib

import numpy as np
import pytest

from cdmisfa.core.config import build, load_preset, section_table
from recorder.config import RecordConfig
from recorder.world.icub.config import EyesConfig, IcubConfig
from recorder.world.icub.lens import SAMPLES, Lens
from recorder.world.icub.textures import SIDE, TEXTURES, texture

pytest.importorskip("pybullet")

from recorder.world.icub.motions import Motions, PhysicalMotions
from recorder.world.icub.source import HEIGHTS, TRUTH, IcubSource

REAL = build(IcubConfig, "scene", load_preset("icub-real")["scene"], {"seed": 1})
SMALL = IcubConfig(
    seed=1,
    eyes=EyesConfig(views=("left", "right"), yaw=(45.0, -45.0), width=24, height=18),
    room=True,
    shadow=0.5,
    noise=2.0,
)
"""A quick one: neither arms nor textures are drawn."""


def seen_in(scene: IcubConfig, *blocks: tuple[int, int, int]) -> list[np.ndarray]:
    """Frames of (view, first, n) of a scene."""
    with IcubSource(scene, RecordConfig()) as source:
        result = []
        for view, first, n in blocks:
            source.seek(first)
            result.append(source.take(view, n).frames)
    return result


def test_what_came_later_is_off_and_unstated_in_the_plain_scene():
    plain = IcubConfig()
    keys = [field.name for field in dataclasses.fields(plain) if field.metadata.get("unstated")]
    assert plain.plain
    assert not set(keys) & set(section_table(plain))
    for key in keys:
        value = type(getattr(plain, key))(1)
        changed = dataclasses.replace(plain, **{key: value})
        assert changed.plain == (key == "transit")  # which changes no frame
        assert section_table(changed)[key] == value
        assert build(IcubConfig, "scene", section_table(changed)) == changed


def test_every_view_shows_a_room_and_its_moving_object():
    for view in seen_in(REAL, *((view, 0, 40) for view in range(3))):
        assert view.shape == (40, 48, 128)
        assert all(len(np.unique(frame)) >= 150 for frame in view)
        assert 90 < view.mean() < 170
        moved = np.abs(view.astype(int) - np.median(view, axis=0)) > 25
        share = moved.mean(axis=(1, 2))
        assert 0.005 < share.mean() < 0.1  # where the object is, and its shadow; no more


def test_bytes_depend_on_view_and_frame_alone():
    whole_left, whole_right = seen_in(SMALL, (0, 0, 70), (1, 0, 70))
    parts = seen_in(SMALL, (1, 60, 10), (0, 0, 1), (0, 1, 33), (1, 3, 2), (0, 34, 36))
    np.testing.assert_array_equal(np.concatenate([parts[1], parts[2], parts[4]]), whole_left)
    np.testing.assert_array_equal(parts[0], whole_right[60:])
    np.testing.assert_array_equal(parts[3], whole_right[3:5])
    assert (whole_left[0] != seen_in(dataclasses.replace(SMALL, seed=2), (0, 0, 1))[0]).any()


def test_a_picture_does_not_depend_on_how_often_its_objects_were_drawn_before():
    """Bullet normalises normals in place: a pixel of frame 4818 went to and fro by one."""
    scene = dataclasses.replace(REAL, seed=0)
    seen = seen_in(scene, (2, 4815, 4), (2, 4810, 9), (2, 4815, 4))
    for frames in seen[1:]:
        np.testing.assert_array_equal(seen[0][-1], frames[-1])


QUIET = dataclasses.replace(SMALL, noise=0.0)


@pytest.fixture(scope="module")
def quiet() -> np.ndarray:
    """Frames of the right view without noise."""
    return seen_in(QUIET, (1, 0, 20))[0]


def test_a_shadow_falls_beside_its_object(quiet):
    (bright,) = seen_in(dataclasses.replace(QUIET, shadow=0.01), (1, 0, 20))
    lost = bright.astype(float) - quiet
    still = np.median(lost, axis=0)
    cast = lost - still > 12  # by what moves
    assert 0.003 < cast.mean() < 0.1
    ratio = (quiet + 1.0) / (bright + 1.0)
    assert ratio[cast].min() > 0.4
    assert (ratio[cast] > 0.7).any()  # its edge is soft
    assert still.max() > 20  # the table shades the floor


def test_colours_beside_one_another_are_what_is_seen_in_grey(quiet):
    (colours,) = seen_in(dataclasses.replace(QUIET, color=True), (1, 0, 3))
    assert colours.shape == (3, 18, 3 * 48)
    red, green, blue = (colours[..., i * 48 : (i + 1) * 48].astype(float) for i in range(3))
    mixed = 0.299 * red + 0.587 * green + 0.114 * blue
    assert np.abs(mixed - quiet[:3]).max() <= 2
    assert (red > blue + 5).any()


def test_physics_moves_objects_after_the_paper_s_motions_upright_on_the_table():
    pushed = dataclasses.replace(SMALL, physics=True, shadow=0.0)
    with contextlib.closing(PhysicalMotions(pushed, 1)) as motions:
        later = motions.positions(100, 30)
        poses = motions.positions(0, 130)
    np.testing.assert_array_equal(poses[100:], later)
    np.testing.assert_array_equal(np.round(poses, 5), poses)
    away = np.abs(poses[..., :2] - Motions(pushed, 1).positions(0, 130))
    assert away.mean(axis=(0, 2)).max() < 0.01
    assert away[:, :2].max() > 0.003  # they follow, and are not put there
    standing = np.array([pushed.object1.half_size, 0.045, pushed.object3.radius])
    assert np.abs(poses[..., 2] - pushed.table.top - standing).max() < 0.001
    np.testing.assert_array_equal(poses[:, :2, 3:], np.tile([0, 0, 0, 1], (130, 2, 1)))
    assert np.abs(poses[:, 2, 3:6]).max() > 0.3  # the ball rolls
    with IcubSource(pushed, RecordConfig()) as source:
        source.seek(5)
        block = source.take(0, 3)
    assert source.spec.truth == (*TRUTH, *HEIGHTS)
    np.testing.assert_array_equal(block.truth[:, :6], poses[5:8, :, :2].reshape(3, 6))
    np.testing.assert_array_equal(block.truth[:, 6:], poses[5:8, :, 2])


def rays_of(level: int, frames: int) -> np.ndarray:
    eyes = EyesConfig()
    size = (frames, eyes.height * SAMPLES, 2, eyes.width * SAMPLES, 1)
    return np.full(size, level, np.uint8)


def test_noise_is_that_of_the_key_and_new_in_every_frame_and_view():
    lens = Lens(IcubConfig(noise=4.0))
    images = lens.through(rays_of(128, 30), 0, 0).astype(float)
    assert abs(images.mean() - 128) < 0.1
    assert abs(images.std() - 4.0) < 0.1
    dark = lens.through(rays_of(20, 10), 0, 0).astype(float)
    assert 2.7 < dark.std() < 3.3
    first, second = (images[i].ravel() for i in (0, 1))
    other = lens.through(rays_of(128, 1), 0, 1).astype(float).ravel()
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.05
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.05
    np.testing.assert_array_equal(lens.through(rays_of(128, 1), 7, 0)[0], images[7])


def test_blur_and_vignette_by_hand():
    rays = rays_of(0, 1)
    rays[0, 20:22, 1, 40:42] = 160
    image = Lens(IcubConfig(blur=True)).through(rays, 0, 0)[0, :, :, :, 0]
    np.testing.assert_array_equal(image[9:12, 1, 19:22], [[10, 20, 10], [20, 40, 20], [10, 20, 10]])
    assert image.sum() == 160
    edge = Lens(IcubConfig(blur=True, vignette=0.5)).through(rays_of(200, 1), 0, 0)[0, ..., 0]
    assert edge[0, 0, 0] == edge[-1, 1, -1] == 100
    assert edge[23:25, :, 31:33].min() >= 199


@pytest.mark.parametrize("name", sorted(TEXTURES))
def test_textures_are_the_same_bytes_everywhere(name):
    drawn = texture(name, (0.6, 0.4, 0.2), 3)
    assert drawn.shape == (SIDE, SIDE, 3)
    assert hashlib.sha256(drawn.tobytes()).hexdigest()[:8] == BYTES[name]
    assert len(np.unique(drawn)) > 40


BYTES = {
    "die": "97bb2fbc",
    "label": "ac9aecb4",
    "plaster": "b56c3154",
    "tiles": "6a00a743",
    "wood": "ee711189",
}
