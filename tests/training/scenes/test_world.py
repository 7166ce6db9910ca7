"""The second domain: panoramas and bumps against closed forms, volumes of meshes, the choice of sources."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dior_rt.errors import InputError
from dior_rt.training.data import render
from dior_rt.training.data.render import LIT, Stage, View, lit, lumi_map, picture, reach, render_scenes, view
from dior_rt.training.data.triplets import load_views
from dior_rt.training.scenes import compound_meshes, skies
from dior_rt.training.scenes.scene import Camera, Material, Scene, Source, Thing, scene
from dior_rt.training.scenes.shapes import box
from dior_rt.training.scenes.textures import fine_texture, relief
from dior_rt.training.scenes.world import world

GREY = Material("matte", np.full((4, 4, 3), 0.5, np.float32), 1.0)
CAMERA = Camera(np.array([0.0, 0.0, 5.0]), np.zeros(3), 20.0)


def wall(material: Material = GREY) -> Thing:
    """It faces the camera, at z = 0."""
    return Thing(box(np.array([4.0, 4.0, 0.1])).placed(np.ones(3), 0.0, np.array([0, 0, -0.1])), material)


def environment(panorama: np.ndarray) -> Source:
    return Source("sky", np.zeros(3), np.zeros(3), 0.0, panorama.astype(np.float32))


def light_of(source: Source, *things: Thing, samples: int = 256) -> np.ndarray:
    return lumi_map(Stage.load(things or (wall(),)), CAMERA, source, 8, samples)


def test_scenes_of_the_plain_domain_stay_what_they_were() -> None:
    """Renders of them exist, and a set that is half rendered goes on with the same scenes."""
    described = scene(0)
    assert (described.kind, len(described.things), described.sources[3].kind) == ("objects", 9, "panel")
    np.testing.assert_allclose(
        described.cameras[1].at, [0.4991669753986334, 2.6225554796937587, 3.8368726919299694], rtol=1e-9
    )
    np.testing.assert_allclose(
        [*described.sources[3].at, described.sources[3].size],
        [-1.37441633147038, 4.696275404801443, -0.6910611643519102, 0.3722031742505321],
        rtol=1e-9,
    )
    last = described.things[-1]
    sums = last.mesh.vertices.sum(dtype=np.float64), last.material.reflectance.sum(dtype=np.float64)
    np.testing.assert_allclose(sums, [-4255.34051029454, 4626.407123319805], rtol=1e-6)
    assert last.material.relief is None


@pytest.mark.parametrize("seed", range(12))
def test_a_panorama_is_light_of_mean_one(seed: int) -> None:
    light = skies.panorama(np.random.default_rng(seed))
    assert light.shape == (skies.ROWS, 2 * skies.ROWS, 3) and np.isfinite(light).all() and (light >= 0).all()
    solid = np.sin((np.arange(skies.ROWS) + 0.5) / skies.ROWS * np.pi)[:, None, None]
    assert (light * solid).sum() / (solid.sum() * light.shape[1] * 3) == pytest.approx(1, abs=1e-3)
    assert np.array_equal(light, skies.panorama(np.random.default_rng(seed)))


def test_an_even_panorama_lights_like_the_dome_and_half_of_it_by_half() -> None:
    """A wall's hemisphere is split by the horizon: either half sends it 1/2 (the cosines' integral)."""
    whole = np.ones((skies.ROWS, 2 * skies.ROWS, 3))
    upper = whole * (np.arange(skies.ROWS) < skies.ROWS / 2)[:, None, None]
    assert light_of(environment(whole)).mean() == pytest.approx(1, abs=0.01)
    assert light_of(environment(upper)).mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("towards", [(0.3, 0.5, 0.8), (-0.8, 0.2, 0.5), (0.7, -0.4, 0.6)])
def test_a_sun_lights_by_the_cosine_from_where_rays_say(towards) -> None:
    direction = np.array(towards) / np.linalg.norm(towards)
    near = skies.rays() @ direction
    sun = (near > np.cos(np.radians(8)))[..., None] * np.array([2.0, 1.0, 0.5])
    solid = np.sqrt(1 - skies.rays()[..., 1:2] ** 2) * (np.pi / skies.ROWS) ** 2
    expected = (sun * solid * np.clip(skies.rays()[..., 2:], 0, None)).sum(axis=(0, 1)) / np.pi
    np.testing.assert_allclose(light_of(environment(sun)).mean(axis=(0, 1)), expected, rtol=0.04)
    away = np.array([1, 1, -1]) * direction  # a sun behind the wall
    hidden = (skies.rays() @ away > np.cos(np.radians(8)))[..., None] * np.ones(3)
    assert light_of(environment(hidden)).max() < 0.05 * expected.max()


def test_a_ramp_of_relief_tilts_the_normal_by_its_slope() -> None:
    """In the Lumi map, and alike in the picture of a matte surface: albedo / 1 of it, if nothing bounces."""
    size, slope = 64, 0.4
    source = Source("sphere", np.array([60.0, 0.0, 80.0]), np.zeros(3), 5.0)  # so far that its light is even
    ramp = np.tile(np.linspace(0, 2 * slope, size, dtype=np.float32), (size, 1))  # 2 units a repeat
    for heights, normal in ((ramp, (-slope, 0, 1)), (0 * ramp + 0.3, (0, 0, 1)), (ramp.T, (0, -slope, 1))):
        material = replace(GREY, relief=heights)
        expected = (5 / 100) ** 2 * (np.array([0.6, 0, 0.8]) @ normal) / np.linalg.norm(normal)
        stage = Stage.load((wall(material),))
        got = lumi_map(stage, CAMERA, source, 16, 64)
        np.testing.assert_allclose(np.median(got), expected, rtol=0.03)
        shown = picture(stage, CAMERA, source, 16, 64)
        np.testing.assert_allclose(np.median(shown), 0.5 * expected, rtol=0.03)


def volume(mesh) -> float:
    """Enclosed, positive if the triangles face outwards (the divergence theorem)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_meshes_enclose_what_their_formulas_say() -> None:
    angle = np.linspace(0, 2 * np.pi, 101)[:-1]
    circle = 0.8 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    area = 50 * 0.64 * np.sin(2 * np.pi / 100)  # of the polygon
    assert volume(compound_meshes.prism(circle, 0.25)) == pytest.approx(0.5 * area, rel=1e-5)
    cylinder = compound_meshes.turned(np.array([[0, 1], [0.5, 1], [0.5, -1], [0, -1]]), around=256)
    assert volume(cylinder) == pytest.approx(np.pi * 0.25 * 2, rel=1e-3)
    path = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    ring = compound_meshes.tube(np.concatenate([path, path[:1]]), 0.1, around=64)
    assert volume(ring) == pytest.approx(2 * np.pi**2 * 0.01, rel=0.02)  # Pappus
    pair = compound_meshes.joined(
        [compound_meshes.bar([1, 1, 1], [0, 0, 0]), compound_meshes.bar([0.5, 0.5, 0.5], [4, 0, 0])]
    )
    assert volume(pair) == pytest.approx(8 + 1, rel=1e-6)


MAKERS = (
    compound_meshes.vessel,
    compound_meshes.column,
    compound_meshes.extruded,
    compound_meshes.knot,
    compound_meshes.plant,
    compound_meshes.cloth,
    compound_meshes.curtain,
    compound_meshes.rock,
    compound_meshes.table,
    compound_meshes.chair,
    compound_meshes.shelf,
    compound_meshes.screen,
)


@pytest.mark.parametrize("maker", MAKERS)
def test_meshes_are_sound_and_repeat_by_their_seed(maker) -> None:
    for seed in range(6):
        mesh = maker(np.random.default_rng(seed))
        assert np.isfinite(mesh.vertices).all() and np.abs(mesh.vertices).max() < 2.5
        assert np.ptp(mesh.vertices, axis=0).max() > 0.5
        assert mesh.faces.max() < len(mesh.vertices) == len(mesh.uv)
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        assert (area > 0).all()
        assert np.array_equal(mesh.vertices, maker(np.random.default_rng(seed)).vertices)


@pytest.mark.parametrize("seed", range(8))
def test_vessels_stones_and_silhouettes_face_outwards(seed: int) -> None:
    for maker in (
        compound_meshes.vessel,
        compound_meshes.rock,
        compound_meshes.extruded,
        compound_meshes.knot,
    ):
        assert volume(maker(np.random.default_rng(seed))) > 0, maker


def test_fine_textures_and_reliefs_have_detail_near_the_texel() -> None:
    """More of their variance lies between neighbours than a smooth raster of the size has."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        colors, heights = fine_texture(rng), relief(rng)
        assert colors.min() >= 0.02 and colors.max() <= 0.9 and colors.shape == (256, 256, 3)
        assert heights.min() >= 0 and heights.max() <= 1 and heights.shape == (256, 256)
        for raster in (colors.mean(axis=2), heights):
            steps = np.mean([np.square(np.diff(raster, axis=axis)).mean() for axis in (0, 1)])
            assert steps > 1e-3 * raster.var() > 0


@pytest.mark.parametrize("seed", range(8))
def test_a_world_repeats_by_its_number_and_hides_its_sources(seed: int) -> None:
    one, again = world(seed), world(seed)
    assert all(
        np.array_equal(a.mesh.vertices, b.mesh.vertices)
        for a, b in zip(one.things, again.things, strict=True)
    )
    assert np.array_equal(one.sources[-1].panorama, again.sources[-1].panorama)
    *local, environment = one.sources
    assert environment.kind == "sky" and len(local) >= 8
    for source in local:
        extent = {"spot": 0.0, "sphere": source.size, "panel": np.sqrt(2) * source.size}[source.kind]
        assert not any(camera.sees(source.at, extent) for camera in one.cameras)
    assert world(seed + 100).sources[0].at[0] != one.sources[0].at[0] != scene(seed).sources[0].at[0]


def test_the_world_has_what_it_is_for() -> None:
    scenes = [world(number, 1) for number in range(16)]
    materials = [thing.material for described in scenes for thing in described.things]
    assert {described.kind for described in scenes} == {"still", "yard", "room"}
    assert np.mean([material.finish != "matte" for material in materials]) > 0.3
    assert np.mean([material.relief is not None for material in materials]) > 0.2
    panels = [s.size for described in scenes for s in described.sources if s.kind == "panel"]
    assert max(panels) > 1.0


def test_a_source_that_lights_next_to_nothing_of_the_view_is_left_out() -> None:
    """One behind the wall, one whose spot misses the picture; the others stay in order."""
    front = [Source("sphere", np.array([2.0 + k, 0.5, 2.0]), np.zeros(3), 0.2) for k in range(6)]
    behind = Source("sphere", np.array([0.0, 0.0, -3.0]), np.zeros(3), 0.2)
    missing = Source("spot", np.array([2.0, 0.0, 2.0]), np.array([2.0, 3.9, 0.0]), 10.0)
    even = environment(np.ones((16, 32, 3)))
    described = Scene("still", (wall(),), (CAMERA,), (behind, front[0], missing, *front[1:], even))
    stage = Stage.load(described.things)
    kept = lit(stage, described, CAMERA)
    assert kept.sources == (*front[: render.SOURCES], even)
    back = np.zeros((16, 32, 3))
    back[:, [0, 1, 2, 29, 30, 31]] = 1  # towards -z, behind the wall
    assert reach(stage, CAMERA, environment(back)) < LIT
    dark = replace(described, sources=(*front, environment(back)))
    assert lit(stage, dark, CAMERA).sources == tuple(front[: render.SOURCES])
    faint = Source("spot", np.array([0.0, 0.0, 2.0]), np.zeros(3), 4.0)  # a small round of light
    none = replace(described, sources=(behind, faint, missing, environment(back)))
    assert lit(stage, none, CAMERA).sources == (faint,)


def test_denoised_renders_are_closer_to_the_truth() -> None:
    described = world(3, 1)
    camera, stage = described.cameras[0], Stage.load(described.things)
    described = replace(described, sources=lit(stage, described, camera).sources[:1])
    make = partial(view, stage, described, camera, 3, resolution=48)
    truth, noisy, clean = make(samples=128), make(samples=4), make(samples=4, denoised=True)
    for name in ("images", "lumi"):
        true, raw, less = (
            np.sqrt(np.clip(getattr(v, name).astype(float), 0, 1)) for v in (truth, noisy, clean)
        )
        assert np.square(less - true).mean() < 0.7 * np.square(raw - true).mean(), name


def test_both_domains_may_share_a_folder(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(render, "view", partial(view, resolution=16, samples=1))
    render_scenes(tmp_path, 1, 0)
    render_scenes(tmp_path, 1, 0, domain="world")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["000000000-0.npz", "000000000-1.npz", "world000000000-0.npz", "world000000000-1.npz"]
    views = load_views(tmp_path)
    assert len(views) == 4
    seen = View.load(tmp_path / names[2])
    assert seen.scene_kind in ("still", "yard", "room") and seen.kinds[-1] == "sky" and len(seen.kinds) <= 5
    assert np.isfinite(seen.images).all() and seen.images.max() > 0


def test_a_domain_that_is_none(tmp_path) -> None:
    with pytest.raises(InputError, match="plain, world"):
        render_scenes(tmp_path, 1, 0, domain="moon")
    assert not list(tmp_path.iterdir())
