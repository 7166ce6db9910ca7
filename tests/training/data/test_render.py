"""Renders: Lumi maps against closed forms, what they do not depend on, and folders of them."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from dior_rt.errors import InputError
from dior_rt.training.data import render
from dior_rt.training.data.render import Stage, View, lumi_map, mitsuba, picture, render_scenes, view
from dior_rt.training.data.triplets import load_views
from dior_rt.training.scenes.scene import Camera, Material, Source, Thing, scene
from dior_rt.training.scenes.shapes import box

GREY = Material("matte", np.full((4, 4, 3), 0.5, np.float32), 1.0)
RED_METAL = Material("metal", np.tile(np.float32([0.9, 0.1, 0.1]), (4, 4, 1)), 0.2)
CAMERA = Camera(np.array([0.0, 0.0, 5.0]), np.zeros(3), 20.0)
SIZE = 8


def block(half, at, material=GREY) -> Thing:
    return Thing(box(np.array(half)).placed(np.ones(3), 0.0, np.array(at)), material)


WALL = block((4.0, 4.0, 0.1), (0.0, 0.0, -0.1))  # it faces the camera, at z = 0


def at_wall(size: int) -> np.ndarray:
    """(size, size, 3) the points of the wall behind the pixels' centres."""
    half = CAMERA.at[2] * np.tan(np.radians(CAMERA.fov / 2))
    along = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(half * along, -half * along)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def to_source(points: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance, and the cosine to the wall's normal, which is +z."""
    away = at - points
    distance = np.linalg.norm(away, axis=-1)
    return distance, away[..., 2] / distance


def lumi(source: Source, things=(WALL,), size: int = SIZE, samples: int = 256) -> np.ndarray:
    return lumi_map(Stage.load(tuple(things)), CAMERA, source, size, samples)


def agree(got: np.ndarray, expected: np.ndarray) -> None:
    """In every pixel but for the noise of sampling, and on the whole closely."""
    ratio = got / np.broadcast_to(expected, got.shape)
    assert np.abs(ratio - 1).max() < 0.15 and abs(ratio.mean() - 1) < 0.01


def sphere(at, radius: float) -> Source:
    return Source("sphere", np.array(at), np.zeros(3), radius)


@pytest.mark.parametrize(
    ("at", "radius"), [((2.0, 0.7, 1.5), 0.05), ((0.0, 0.0, 8.0), 0.5), ((-2.0, 1.0, 2.0), 1.2)]
)
def test_a_sphere_lights_by_the_cosine_and_the_inverse_square(at, radius) -> None:
    distance, cosine = to_source(at_wall(SIZE), np.array(at))
    expected = ((radius / distance) ** 2 * cosine)[..., None]
    agree(lumi(sphere(at, radius)), expected)


def test_a_spot_lights_like_a_point_inside_its_beam_and_nowhere_outside() -> None:
    source = Source("spot", np.array([1.5, 0.5, 2.0]), np.array([0.3, 0.1, 0.0]), 16.0)
    points = at_wall(32)
    distance, cosine = to_source(points, source.at)
    axis = (source.target - source.at) / np.linalg.norm(source.target - source.at)
    off_axis = np.degrees(np.arccos((points - source.at) @ axis / distance))
    got = lumi(source, size=32, samples=64)
    # The beam is full up to three quarters of the half angle; a pixel is about 0.7 degrees wide.
    full, dark = off_axis < 0.75 * source.size - 1, off_axis > source.size + 1
    assert full.sum() > 50 and dark.sum() > 50
    expected = (cosine / (np.pi * distance**2))[full]
    np.testing.assert_allclose(got[full], np.repeat(expected[:, None], 3, 1), rtol=0.03)
    assert (got[dark] == 0).all()


def lambert(point: np.ndarray, corners: np.ndarray) -> float:
    """Irradiance / pi at a point of normal +z from a polygon of radiance 1 (Lambert 1760)."""
    rays = (corners - point) / np.linalg.norm(corners - point, axis=1, keepdims=True)
    total = 0.0
    for one, other in pairwise([*rays, rays[0]]):
        edge = np.cross(one, other)
        total += np.arccos(one @ other) * edge[2] / np.linalg.norm(edge)
    return abs(total) / (2 * np.pi)


def test_a_panel_lights_by_its_form_factor() -> None:
    source = Source("panel", np.array([2.2, 0.8, 2.5]), np.array([0.2, 0.0, 0.0]), 0.6)
    forward = (source.target - source.at) / np.linalg.norm(source.target - source.at)
    left = np.cross([0.0123, 1, 0.0321], forward)
    left /= np.linalg.norm(left)
    up = np.cross(forward, left)
    corners = np.array(
        [source.at + source.size * (a * left + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    expected = np.array([[lambert(point, corners) for point in row] for row in at_wall(SIZE)])
    agree(lumi(source), expected[..., None])


def test_the_dome_over_an_open_wall_is_its_own_radiance() -> None:
    got = lumi(Source("dome", np.zeros(3), np.zeros(3), 0.0), samples=512)
    assert abs(got.mean() - 1) < 0.01 and np.abs(got - 1).max() < 0.2


def crosses(points: np.ndarray, to: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Whether the straight ways from points to `to` meet an axis-aligned box (the slab test)."""
    with np.errstate(divide="ignore"):
        near, far = (low - points) / (to - points), (high - points) / (to - points)
    enters = np.minimum(near, far).max(axis=-1)
    leaves = np.maximum(near, far).min(axis=-1)
    return (enters < leaves) & (leaves > 0) & (enters < 1)


def test_a_shadow_falls_where_geometry_puts_it() -> None:
    source = Source("spot", np.array([2.0, 0.2, 2.0]), np.zeros(3), 60.0)
    middle, half = np.array([1.2, 0.1, 1.2]), np.array([0.15, 0.2, 0.1])
    got = lumi(source, (WALL, block(half, middle)), size=48, samples=16)[..., 0]
    points = at_wall(48)
    pixel = points[0, 1, 0] - points[0, 0, 0]
    corners = [points + pixel / 2 * np.array([a, b, 0]) for a in (-1, 1) for b in (-1, 1)]
    shaded = np.stack([crosses(corner, source.at, middle - half, middle + half) for corner in corners])
    inside, outside = shaded.all(axis=0), ~shaded.any(axis=0)
    assert inside.sum() > 50 and outside.sum() > 50 and (~inside & ~outside).sum() < 300
    assert (got[inside] == 0).all() and (got[outside] > 0).all()


def render_all(sources, colors, samples: int) -> np.ndarray:
    """The Lumi map of several coloured sources at once, which training renders one by one."""
    mi = mitsuba()
    emitters = {}
    for k, (source, color) in enumerate(zip(sources, colors, strict=True)):
        emitter = render.emitter_of(source)
        emitter["emitter"]["radiance"]["value"] = list(color)
        emitters[f"source{k}"] = emitter
    described = {
        "type": "scene",
        "integrator": {"type": "direct", "hide_emitters": True},
        "sensor": render._sensor(CAMERA, SIZE),
        **emitters,
        **Stage.load((WALL,)).white.things,
    }
    return np.array(mi.render(mi.load_dict(described), spp=samples, seed=0), np.float32)[..., :3]


def test_maps_of_several_sources_add_and_follow_strength_and_colour() -> None:
    one, other = sphere((2.0, 0.7, 1.5), 0.3), sphere((-2.0, -0.5, 2.5), 0.6)
    colors = np.float32([[3, 1.5, 0]]), np.float32([[0, 0.5, 4]])
    together = render_all([one, other], [color[0] for color in colors], 1024)
    expected = lumi(one) * colors[0] + lumi(other) * colors[1]
    agree(together, expected)


def test_strength_and_colour_scale_a_map_exactly() -> None:
    source, color = sphere((2.0, 0.7, 1.5), 0.3), np.float32([4, 1, 0.25])
    np.testing.assert_allclose(render_all([source], [color], 4), lumi(source, samples=4) * color, rtol=1e-5)


def test_no_material_leaves_a_trace_in_a_map_while_pictures_differ() -> None:
    described = scene(3, 1)
    other = tuple(Thing(thing.mesh, RED_METAL) for thing in described.things)
    camera, source = described.cameras[0], described.sources[0]
    maps = [lumi_map(Stage.load(things), camera, source, 16, 2) for things in (described.things, other)]
    assert maps[0].any() and np.array_equal(*maps)
    pictures = [picture(Stage.load(things), camera, source, 16, 2) for things in (described.things, other)]
    assert not np.allclose(*pictures)


def on_surface(source: Source) -> np.ndarray:
    """Points all over a local source."""
    rng = np.random.default_rng(0)
    if source.kind == "sphere":
        ball = rng.normal(size=(500, 3))
        return source.at + source.size * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    if source.kind == "spot":
        return source.at[None]
    mi = mitsuba()
    to_world = np.array(render.emitter_of(source)["to_world"].matrix)
    square = np.concatenate([rng.uniform(-1, 1, (500, 2)), [[-1, -1], [-1, 1], [1, -1], [1, 1]]])
    local = np.column_stack([square, np.zeros(len(square)), np.ones(len(square))])
    assert mi.variant() == "scalar_rgb"
    return (local @ to_world.T)[:, :3]


@pytest.mark.parametrize("seed", range(12))
def test_no_camera_sees_a_source(seed: int) -> None:
    described = scene(seed)
    assert [source.kind for source in described.sources][-1] == "dome"
    for camera in described.cameras:
        forward = (camera.target - camera.at) / np.linalg.norm(camera.target - camera.at)
        right = np.cross(forward, [0, 1, 0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        reach = np.tan(np.radians(camera.fov / 2))
        for source in described.sources[:-1]:
            x, y, depth = np.stack([right, up, forward]) @ (on_surface(source) - camera.at).T
            framed = (depth > 0) & (np.abs(x) < reach * depth) & (np.abs(y) < reach * depth)
            assert not framed.any(), source


def test_a_scene_repeats_by_its_seed() -> None:
    one, again, other = scene(5), scene(5), scene(6)
    for a, b in zip(one.things, again.things, strict=True):
        assert np.array_equal(a.mesh.vertices, b.mesh.vertices)
        assert np.array_equal(a.material.reflectance, b.material.reflectance)
    assert all(np.array_equal(a.at, b.at) for a, b in zip(one.sources, again.sources, strict=True))
    assert not np.array_equal(one.sources[0].at, other.sources[0].at)


def test_a_view_holds_every_source_at_unit_mean_and_survives_the_disk(tmp_path) -> None:
    described = scene(1, 1)
    made = view(Stage.load(described.things), described, described.cameras[0], 1, resolution=12, samples=2)
    assert made.images.shape == made.lumi.shape == (5, 12, 12, 3)
    assert made.images.dtype == np.float16 and np.isfinite(made.images).all() and (made.images >= 0).all()
    means = made.lumi.astype(np.float32).mean(axis=(1, 2, 3))
    lit = means > 0
    assert lit[-1]
    np.testing.assert_allclose(means[lit], 0.25, rtol=0.01)
    made.save(tmp_path / "0-0.npz")
    back = View.load(tmp_path / "0-0.npz")
    assert np.array_equal(back.images, made.images) and np.array_equal(back.lumi, made.lumi)
    assert (back.kinds, back.scene_kind, back.seed) == (made.kinds, made.scene_kind, made.seed)


def test_shards_share_the_work_and_a_second_run_renders_nothing(tmp_path, monkeypatch) -> None:
    rendered = []

    def counted(stage, described, camera, number, denoised):
        rendered.append(number)
        return view(stage, described, camera, number, resolution=4, samples=1)

    monkeypatch.setattr(render, "view", counted)
    for index in (0, 1):
        before = set(tmp_path.iterdir())
        render_scenes(tmp_path, 3, 2, (index, 2))
        names = {path.name for path in set(tmp_path.iterdir()) - before}
        mine = [2_000_000 + k for k in (0, 1, 2) if k % 2 == index]
        assert names == {f"{number:09d}-{v}.npz" for number in mine for v in (0, 1)}
    assert sorted(rendered) == [2_000_000, 2_000_000, 2_000_001, 2_000_001, 2_000_002, 2_000_002]
    rendered.clear()
    steps = []
    render_scenes(tmp_path, 3, 2, (0, 1), lambda done, total: steps.append((done, total)))
    assert rendered == [] and steps == [(1, 3), (2, 3), (3, 3)]


def test_what_was_half_written_is_rendered_again_and_the_same(renders, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(render, "view", partial(view, resolution=24, samples=2))
    name = "007000000-0.npz"
    whole = (renders / name).read_bytes()
    (tmp_path / f".{name}.0badcafe").write_bytes(whole[: len(whole) // 2])  # where a killed process stopped
    with pytest.raises(InputError, match="no renders"):
        load_views(tmp_path)
    render_scenes(tmp_path, 1, 7)
    first, _ = load_views(tmp_path)
    assert np.array_equal(first.images, View.load(renders / name).images)


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"no render at all"])
def test_a_damaged_render_is_named(renders, tmp_path, damage) -> None:
    path = tmp_path / "007000000-0.npz"
    path.write_bytes(damage((renders / path.name).read_bytes()))
    with pytest.raises(InputError, match=r"007000000-0\.npz is no render"):
        load_views(tmp_path)
