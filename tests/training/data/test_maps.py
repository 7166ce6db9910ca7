"""Irradiance, shading and Phong maps: closed forms, what they depend on and what not, folders of them."""

from dataclasses import replace

import numpy as np
import pytest

from dior_rt.errors import InputError
from dior_rt.training.data.maps import EXPONENT, KINDS, LUMI, SPECULAR, Shot, Stages, render_maps, with_maps
from dior_rt.training.data.render import Shapes, Stage, View, emitter_of
from dior_rt.training.scenes.scene import Camera, Material, Source, Thing
from dior_rt.training.scenes.shapes import box

CAMERA = Camera(np.array([0.0, 0.0, 5.0]), np.zeros(3), 20.0)
SIZE, SAMPLES = 8, 256
LAMP = Source("sphere", np.array([2.0, 0.7, 1.5]), np.zeros(3), 0.2)
OTHER = Source("panel", np.array([-2.0, 1.0, 3.0]), np.zeros(3), 0.5)


def plain(color, finish="matte") -> Material:
    return Material(finish, np.tile(np.float32(color), (4, 4, 1)), 0.3)


RED, WHITE = plain((0.8, 0.2, 0.1)), plain((1, 1, 1))


def wall(material: Material) -> Thing:
    """It faces the camera, at z = 0, and fills its view; alone, it sends no light to itself."""
    return Thing(box(np.array((4.0, 4.0, 0.1))).placed(np.ones(3), 0.0, np.array((0.0, 0.0, -0.1))), material)


def shelf(material: Material) -> Thing:
    """It stands out of the wall, below what the camera sees, and throws light on it."""
    return Thing(box(np.array((4.0, 0.1, 1.0))).placed(np.ones(3), 0.0, np.array((0.0, -1.2, 1.0))), material)


def shot(source: Source = LAMP, size: int = SIZE, camera: Camera = CAMERA) -> Shot:
    return Shot(camera, source, size, SAMPLES)


def all_maps(stages: Stages, of: Shot) -> dict[str, np.ndarray]:
    albedo = of.albedo(stages)
    rasters = (of.lumi(stages), of.irradiance(stages, albedo), of.shading(stages, albedo), of.phong(stages))
    return dict(zip(KINDS, rasters, strict=True))


def agree(got: np.ndarray, expected: np.ndarray, within: float = 0.15) -> None:
    """In every pixel but for the noise of sampling, and on the whole closely."""
    ratio = got / expected
    assert np.abs(ratio - 1).max() < within and abs(ratio.mean() - 1) < 0.01


def test_the_reflectance_is_the_materials_whatever_its_finish() -> None:
    for finish in ("matte", "plastic", "metal"):
        stages = Stages.load((wall(plain((0.8, 0.2, 0.1), finish)),))
        np.testing.assert_allclose(
            shot().albedo(stages), np.broadcast_to(RED.reflectance[0, 0], (8, 8, 3)), rtol=1e-4
        )


def test_where_nothing_bounces_irradiance_and_shading_are_the_lumi_map() -> None:
    stages = Stages.load((wall(RED),))
    maps = all_maps(stages, shot())
    agree(maps["irradiance"], maps[LUMI])
    agree(maps["shading"], maps[LUMI])


def test_light_that_bounced_is_in_irradiance_in_its_colour_and_not_in_the_lumi_map() -> None:
    bare, corner = (
        all_maps(Stages.load(things), shot()) for things in ((wall(WHITE),), (wall(WHITE), shelf(RED)))
    )
    agree(corner[LUMI], bare[LUMI])
    more = (corner["irradiance"] - bare["irradiance"]).mean(axis=(0, 1))
    assert more[0] > 0.1 * bare[LUMI].mean()
    assert more[0] > 2 * more[1] > 3 * more[2] > 0


def test_shading_of_a_white_scene_is_its_irradiance() -> None:
    maps = all_maps(Stages.load((wall(WHITE), shelf(WHITE))), shot())
    np.testing.assert_allclose(maps["shading"], maps["irradiance"], rtol=1e-5)


def test_gloss_is_in_shading_and_not_in_irradiance() -> None:
    matte, metal = (
        all_maps(Stages.load((wall(plain((0.8, 0.2, 0.1), finish)),)), shot())
        for finish in ("matte", "metal")
    )
    np.testing.assert_array_equal(metal["irradiance"], matte["irradiance"])
    assert np.abs(metal["shading"] / matte["shading"] - 1).mean() > 0.2


def test_a_phong_map_without_highlight_is_the_lumi_map() -> None:
    maps = all_maps(Stages.load((wall(RED),), specular=0.0), shot())
    agree(maps["phong"], maps[LUMI])


def test_the_highlight_is_blinns() -> None:
    """Of a small lamp, over the Lumi map: 1 - s + s pi D / (4 cos_i cos_o), D = (n + 2) / (2 pi) cos_h^n."""
    lamp, size = Source("sphere", np.array([1.5, 0.0, 4.0]), np.zeros(3), 0.1), 16
    maps = all_maps(Stages.load((wall(RED),)), shot(lamp, size))
    half = CAMERA.at[2] * np.tan(np.radians(CAMERA.fov / 2))
    along = ((np.arange(size) + 0.5) / size * 2 - 1) * half
    points = np.stack([*np.meshgrid(along, -along), np.zeros((size, size))], axis=-1)
    inward, outward = (
        (at - points) / np.linalg.norm(at - points, axis=2, keepdims=True) for at in (lamp.at, CAMERA.at)
    )
    middle = inward + outward
    cosine = (middle / np.linalg.norm(middle, axis=2, keepdims=True))[..., 2]
    lobe = (EXPONENT + 2) / 2 * cosine**EXPONENT / (4 * inward[..., 2] * outward[..., 2])
    expected = 1 - SPECULAR + SPECULAR * lobe
    assert expected.max() > 1.3 * expected.min()  # the highlight is in view, and its foot as well
    got = (maps["phong"] / maps[LUMI]).mean(axis=2)
    np.testing.assert_allclose(got, expected, rtol=0.12)


def test_only_the_phong_map_and_shading_turn_with_the_view() -> None:
    """The middle of the wall, from the front, and from where a mirror would send the light."""
    mirrored = Camera(2 * LAMP.at * np.array([-1.0, -1.0, 1.0]), np.zeros(3), 4.0)
    stages = Stages.load((wall(plain((0.5, 0.5, 0.5), "plastic")),))
    front, side = (
        {kind: raster.mean() for kind, raster in all_maps(stages, shot(camera=at)).items()}
        for at in (replace(CAMERA, fov=4.0), mirrored)
    )
    for kind in (LUMI, "irradiance"):
        assert side[kind] == pytest.approx(front[kind], rel=0.03)
    for kind in ("phong", "shading"):
        assert side[kind] > 1.3 * front[kind]


@pytest.mark.parametrize("kind", KINDS)
def test_maps_of_sources_add(kind) -> None:
    things = (wall(RED), shelf(plain((0.3, 0.6, 0.9), "plastic")))
    stages = Stages.load(things)
    lamp = {"other": emitter_of(OTHER)}
    both = Stages(
        *(
            Stage(Shapes(stage.original.things | lamp), Shapes(stage.white.things | lamp))
            for stage in (stages.original_stage, stages.matte, stages.glossy)
        )
    )
    one, other, together = (
        all_maps(each, shot(source))[kind] for each, source in ((stages, LAMP), (stages, OTHER), (both, LAMP))
    )
    agree(together, one + other, within=0.35)


def test_a_view_keeps_its_pictures_and_its_lumi_map_under_every_map(views) -> None:
    view = views[0]
    maps = with_maps(view, samples=2)
    assert tuple(maps) == KINDS
    for kind, other in maps.items():
        np.testing.assert_array_equal(other.images, view.images)
        assert other.lumi.shape == view.lumi.shape and other.lumi.dtype == np.float16
        assert np.isfinite(other.lumi).all() and (other.lumi >= 0).all()
        assert np.array_equal(other.lumi, view.lumi) == (kind == LUMI)
    # In the pictures' units: what bounces comes on top of the straight light, on the whole.
    assert maps["irradiance"].lumi.mean(dtype=np.float32) > view.lumi.mean(dtype=np.float32)


def test_maps_are_refused_for_a_view_of_another_scene(views) -> None:
    with pytest.raises(InputError, match="render it anew"):
        with_maps(replace(views[0], lumi=views[2].lumi), samples=2)
    with pytest.raises(InputError, match="render it anew"):
        with_maps(views[1], camera=0, samples=2)


@pytest.mark.slow
def test_a_folder_of_maps_is_made_once_and_whole(renders, tmp_path) -> None:
    seen = []
    render_maps(renders, tmp_path, 1, first=1, samples=2, progress=lambda *step: seen.append(step))
    written = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*"))
    assert written == sorted(f"{kind}/007000001-0.npz" for kind in KINDS) and seen == [(1, 1)]
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    (tmp_path / "phong" / "007000001-0.npz").unlink()
    View.load(tmp_path / "shading" / "007000001-0.npz")
    render_maps(renders, tmp_path, 1, first=1, samples=2)
    after = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    assert set(before) == set(after)
    render_maps(renders, tmp_path, 1, first=1, samples=2)
    assert after == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}


def test_too_few_renders_are_refused_and_nothing_is_made(renders, tmp_path) -> None:
    with pytest.raises(InputError, match="fewer than 9"):
        render_maps(renders, tmp_path / "maps", 9)
    assert not (tmp_path / "maps").exists()
