"""The data renderer against closed forms: what light in Blender's Cycles has to obey whatever the scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dior_rt.training.blender import meshes  # noqa: E402
from dior_rt.training.blender.cycles import ShootOptions, Studio  # noqa: E402
from dior_rt.training.blender.meshes import Finish  # noqa: E402
from dior_rt.training.blender.scene import BlenderScene, Camera, Gobo, Lamp, Panorama, Thing  # noqa: E402

ABOVE = Camera((0.0, -0.001, 4.0), (0.0, 0.0, 0.0), 53.130102)  # sees the ground from -2 to 2 metres
SIDE = 32
QUICK = ShootOptions(resolution=SIDE, samples=64, lumi_samples=64, bounces=2)


GREY = Finish()


def ground(finish: Finish = GREY) -> Thing:
    return Thing(meshes.box((20, 20, 0.1)).finished(finish), (0, 0, -0.1), role="shell")


def scene(*things: Thing) -> BlenderScene:
    return BlenderScene("test", 0, "train", things, Panorama("none", 0.0), (), 1.0)


def shoot(things, lamps, options=QUICK, camera=ABOVE, panorama=None):
    with Studio(scene(*things), panorama, options) as studio:
        return studio.shoot(camera, lamps)


def point(at, size=0.001, **more) -> Lamp:
    return Lamp("point", at, (at[0], at[1], 0.0), size, "test", **more)


@pytest.fixture
def panorama(tmp_path):
    """A sky that is twice as bright above as below."""
    import OpenEXR

    light = np.ones((16, 32, 3), np.float32) * np.linspace(2, 1, 16, dtype=np.float32)[:, None, None]
    OpenEXR.File({}, {"RGB": light}).write(str(tmp_path / "sky.exr"))
    return tmp_path / "sky.exr"


def positions() -> tuple[np.ndarray, np.ndarray]:
    """x and y on the ground of ABOVE's pixels."""
    steps = ((np.arange(SIDE) + 0.5) / SIDE * 2 - 1) * 2
    return np.meshgrid(steps, -steps)


def test_light_of_a_point_falls_with_the_square_of_the_distance_and_the_cosine():
    lumi = shoot([ground()], [point((0.3, 0.2, 1.5))]).lumi[0, ..., 0]
    x, y = positions()
    expected = 1.5 / ((x - 0.3) ** 2 + (y - 0.2) ** 2 + 1.5**2) ** 1.5
    ratio = lumi / expected
    assert ratio.std() / ratio.mean() < 0.01


def test_lumi_is_irradiance_by_pi():
    # A sun of unit irradiance at 60 degrees from the normal: 1 * cos(60) / pi.
    slanted = Lamp("sun", (math.sqrt(3), 0.0, 1.0), (0.0, 0.0, 0.0), 0.01, "test")
    lumi = shoot([ground()], [slanted]).lumi[0]
    assert np.allclose(lumi, 0.5 / math.pi, rtol=0.01)


def test_the_edge_of_a_shadow_lies_where_the_geometry_says():
    # A plate from x = 0 at height 1 under a lamp at height 2: the shadow's edge is at x = 0 + 0.4 * 1 away.
    plate = Thing(meshes.box((3, 8, 0.001)), (1.5, 0, 1.0))
    lamp = point((-0.4, 0.0, 2.0))
    behind = Camera((0.0, -4.0, 0.9), (0.0, 0.0, 0.0), 40.0)
    options = replace(QUICK, resolution=64)
    shot = shoot([ground(), plate], [lamp], options, behind)
    ground_seen = np.rint(shot.ids) == 1
    rays = behind.rays(64).reshape(64, 64, 3)
    at = np.asarray(behind.at) + rays * (-behind.at[2] / rays[..., 2:])
    x = at[..., 0]
    near = ground_seen & (np.abs(at[..., 1]) < 4)  # beyond, light passes the plate
    open_light = 2.0 / np.linalg.norm(at - lamp.at, axis=2) ** 3
    share = shot.lumi[0, ..., 0] / open_light
    lit = share > 0.5 * share[near].max()
    assert lit[near & (x < 0.33)].mean() > 0.98
    assert lit[near & (x > 0.47)].mean() < 0.02


def test_lights_add_and_light_groups_are_the_lights_alone():
    things = [ground(), Thing(meshes.ball(0.6), (0, 0, 0))]
    lamps = [point((1.0, 0.5, 2.0)), point((-1.0, 0.0, 1.5))]
    both = shoot(things, lamps, replace(QUICK, samples=256))
    for k, lamp in enumerate(lamps):
        alone = shoot(things, [lamp], replace(QUICK, samples=256, seed=5)).images[0]
        assert both.images[k].mean() == pytest.approx(alone.mean(), rel=0.01)
        assert np.abs(both.images[k] - alone).mean() < 0.05 * alone.mean()


def test_a_picture_is_linear_in_the_albedo_without_bounces():
    flat = replace(QUICK, bounces=0)
    dark, light = (
        shoot([ground(Finish(color=(v, v, v), roughness=1.0))], [point((0.3, 0.0, 2.0))], flat)
        for v in (0.2, 0.8)
    )
    assert light.albedo[..., 0].mean() == pytest.approx(0.8, abs=0.05)
    # Principled surfaces send back a small gloss besides, which does not change.
    gain = (light.images[0] - dark.images[0]).mean() / shoot([ground()], [point((0.3, 0.0, 2.0))]).lumi[
        0
    ].mean()
    assert gain == pytest.approx(0.6, rel=0.05)


def test_lumi_maps_do_not_change_with_the_materials():
    texture = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    plain, other = (
        shoot([ground(finish), Thing(meshes.ball(0.6).finished(finish), (0, 0, 0))], [point((1.0, 0.5, 2.0))])
        for finish in (
            Finish(),
            Finish(color=(0.9, 0.2, 0.1), texture=texture, box=2.0, metallic=1.0, roughness=0.2),
        )
    )
    assert np.allclose(plain.lumi, other.lumi, rtol=1e-3, atol=1e-5)
    assert not np.allclose(plain.images, other.images, rtol=0.1)


def test_the_sky_is_marked_and_dark_in_every_lumi_map(panorama):
    level = Camera((0.0, -5.0, 1.0), (0.0, 0.0, 1.0), 50.0)
    shot = shoot([ground()], [point((0.0, 0.0, 2.0))], camera=level, panorama=panorama)
    sky = shot.sky > 0.99
    assert 0.3 < sky.mean() < 0.6
    assert np.all(shot.lumi[:, sky] == 0)
    assert np.all(shot.images[0][sky] == 0)
    assert np.all(shot.images[1][sky] > 0.5)  # the picture shows the sky
    assert np.all(np.rint(shot.ids)[sky] == 0)


def test_normals_depth_and_ids(panorama):
    ball = Thing(meshes.ball(0.5), (0.0, 0.0, 0.0))
    shot = shoot([ground(), ball], [point((0.0, 0.0, 3.0))])
    x, y = positions()
    flat = np.hypot(x, y) > 0.8
    assert np.all(np.rint(shot.ids)[flat] == 1)
    assert np.allclose(shot.normals[flat], [0, 0, 1], atol=0.02)
    assert np.allclose(shot.depth[flat], 4.0, rtol=0.01)
    assert shot.depth[SIDE // 2, SIDE // 2] == pytest.approx(3.0, abs=0.02)
    assert np.rint(shot.ids)[SIDE // 2, SIDE // 2] == 2


def test_a_flag_keeps_light_off_one_half():
    flag = Gobo("flag", 1.0, 0.0, 0.0, 0.02)
    lumi = shoot([ground()], [point((0.0, 0.0, 1.5), gobo=flag)]).lumi[0, ..., 0]
    open_lumi = shoot([ground()], [point((0.0, 0.0, 1.5))]).lumi[0, ..., 0]
    share = lumi / open_lumi
    assert 0.4 < (share > 0.95).mean() < 0.6
    assert 0.4 < (share < 0.05).mean() < 0.6


def test_glass_lets_light_through_in_both_passes():
    pane = Thing(meshes.box((6, 6, 0.01)).finished(Finish(color=(1, 1, 1), glass=0.8)), (0, 0, 3.0))
    above = [point((0.0, 0.0, 3.5))]
    covered = shoot([ground(), pane], above, camera=Camera((0.0, -0.001, 2.5), (0, 0, 0), 50.0))
    bare = shoot([ground()], above, camera=Camera((0.0, -0.001, 2.5), (0, 0, 0), 50.0))
    # Two faces of the pane, each with 0.8.
    assert covered.lumi.mean() == pytest.approx(0.64 * bare.lumi.mean(), rel=0.02)
    assert covered.images.mean() < 0.7 * bare.images.mean()
    assert covered.images.mean() > 0.4 * bare.images.mean()


def test_the_same_seed_gives_the_same_picture():
    things = [ground(), Thing(meshes.ball(0.5), (0, 0, 0))]
    few = replace(QUICK, samples=2, lumi_samples=2)
    first, again, other = (
        shoot(things, [point((0.5, 0, 2.0), size=0.3)], replace(few, seed=seed)) for seed in (1, 1, 2)
    )
    assert np.array_equal(first.images, again.images)
    assert np.array_equal(first.lumi, again.lumi)
    assert not np.array_equal(first.images, other.images)
