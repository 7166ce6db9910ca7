"""Triplets: sums of single sources in linear light, honest strokes, and batches that repeat."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import label

from dior_rt.families import mini
from dior_rt.kernels import NumpyOps, Strokes
from dior_rt.training.data.camera import Camera, random_camera
from dior_rt.training.data.triplets import (
    GRIDS,
    KINDS,
    PARTS,
    Batches,
    Mix,
    Pair,
    Shots,
    dab,
    draw,
    example,
    flag,
    flat,
    mix,
    pair,
    part,
    random_lights,
    tint,
    zoomed,
)
from dior_rt.training.light import decode_lumi, linear_to_srgb


def pairs(views, kind: str, count: int = 12) -> list[tuple]:
    """(view, pair) of one kind, on views in single precision."""
    chosen = [views[k % len(views)] for k in range(count)]
    fine = [replace(v, images=v.images.astype(np.float32), lumi=v.lumi.astype(np.float32)) for v in chosen]
    return [(view, pair(np.random.default_rng(k), view, kind)) for k, view in enumerate(fine)]


def lights_of(view, lumi: np.ndarray) -> np.ndarray:
    """(sources, 3) the lights that make a Lumi map, found by least squares; asserts that they do."""
    found = np.empty((len(view.lumi), 3))
    for c in range(3):
        columns = view.lumi[..., c].reshape(len(view.lumi), -1).T.astype(np.float64)
        found[:, c] = np.linalg.lstsq(columns, lumi[..., c].ravel().astype(np.float64), rcond=None)[0]
        residual = columns @ found[:, c] - lumi[..., c].ravel()
        assert np.abs(residual).max() < 1e-3 * max(1, lumi.max())
    return found


def test_a_mix_is_linear_in_its_lights(views) -> None:
    rng = np.random.default_rng(0)
    one, other = rng.uniform(0, 2, (2, 5, 3)).astype(np.float32)
    both = mix(views[0], 3 * one + other)
    for whole, a, b in zip(both, mix(views[0], one), mix(views[0], other), strict=True):
        np.testing.assert_allclose(whole, 3 * a + b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_are_float32_pictures_on_display(views, kind: str) -> None:
    for _, sample in pairs(views, kind):
        rasters = sample.photo, sample.relit, sample.source, sample.target
        assert sample.kind == kind
        assert all(raster.dtype == np.float32 and raster.shape == (24, 24, 3) for raster in rasters)
        assert all(raster.min() >= 0 and np.isfinite(raster).all() for raster in rasters)
        assert sample.photo.max() <= 1 and sample.relit.max() <= 1 and sample.photo.max() > 0.2


@pytest.mark.parametrize("kind", ["change", "replace", "keep"])
def test_pictures_and_their_maps_come_of_the_same_lights_and_exposure(views, kind: str) -> None:
    for view, sample in pairs(views, kind, 6):
        for picture, lumi in ((sample.photo, sample.source), (sample.relit, sample.target)):
            image = np.einsum("khwc,kc->hwc", view.images, lights_of(view, lumi))
            np.testing.assert_allclose(picture, np.clip(image, 0, 1), atol=5e-3)


def test_keep_keeps_everything(views) -> None:
    for _, sample in pairs(views, "keep"):
        assert np.array_equal(sample.photo, sample.relit) and np.array_equal(sample.source, sample.target)


def test_change_changes_one_light_under_the_shared_exposure(views) -> None:
    for view, sample in pairs(views, "change"):
        before, after = lights_of(view, sample.source), lights_of(view, sample.target)
        scale = max(before.max(), after.max())
        changed = (np.abs(after - before) > 2e-3 * scale).any(axis=1)
        assert changed.sum() == 1
        assert (after.max(axis=1) > 1e-3 * scale).any(), "the last light went out"


def test_replace_changes_more_than_one_light_most_of_the_time(views) -> None:
    counts = []
    for view, sample in pairs(views, "replace"):
        before, after = lights_of(view, sample.source), lights_of(view, sample.target)
        counts.append((np.abs(after - before) > 2e-3 * max(before.max(), after.max())).any(axis=1).sum())
    assert np.mean(np.array(counts) >= 2) > 0.5


def test_dim_sources_are_never_lit() -> None:
    usable = np.array([True, False, False, True, False])
    for seed in range(50):
        lights = random_lights(np.random.default_rng(seed), usable)
        assert lights[usable].any() and not lights[~usable].any()


def test_tints_are_colours_of_about_unit_luminance() -> None:
    rng = np.random.default_rng(0)
    tints = np.stack([tint(rng) for _ in range(500)])
    assert (tints >= 0).all() and 0.8 < tints.mean() < 1.2 and tints.std(axis=1).max() > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_strokes_say_what_light_is_there(views, kind: str) -> None:
    masks = []
    for k, (_, sample) in enumerate(pairs(views, kind)):
        light, mask = draw(np.random.default_rng(k), NumpyOps(), sample)
        inside = mask > 0
        assert light.dtype == mask.dtype == np.float32 and set(np.unique(mask)) <= {0, 1} and inside.any()
        assert not light[~inside].any()
        # A stroke's own values, a cell's mean, or one colour for all: each keeps the light's mean.
        drawn, true = light[inside].mean(axis=0), sample.target[inside].mean(axis=0)
        np.testing.assert_allclose(drawn, true, rtol=2e-3, atol=1e-5)
        assert (light <= sample.target.max(axis=(0, 1)) * 1.001).all()
        masks.append(inside.mean())
    assert min(masks) < 0.5


def test_strokes_of_a_change_seek_the_change() -> None:
    source = np.full((64, 64, 3), 0.5, np.float32)
    target = source.copy()
    target[:, 40:] = 2.0
    sample = Pair("change", source, source, source, target)
    masks = [draw(np.random.default_rng(k), NumpyOps(), sample)[1] for k in range(30)]
    right = np.mean([mask[:, 40:].mean() for mask in masks])
    left = np.mean([mask[:, :24].mean() for mask in masks])
    assert right > 1.5 * left


def test_a_zoomed_pair_keeps_its_light(views) -> None:
    _, sample = pairs(views, "replace", 1)[0]
    small, mirrored = zoomed(sample, (8, 12)), zoomed(sample, (8, 12), mirror=True)
    for name in ("photo", "relit", "source", "target"):
        raster, few = getattr(sample, name), getattr(small, name)
        assert few.shape == (8, 12, 3) and few.dtype == np.float32
        np.testing.assert_allclose(few.mean(axis=(0, 1)), raster.mean(axis=(0, 1)), rtol=0.1)
        np.testing.assert_array_equal(getattr(mirrored, name), few[:, ::-1])


def test_a_part_of_a_view_is_that_part(views) -> None:
    cut = part(views[0], slice(3, 19), slice(5, 23))
    np.testing.assert_array_equal(cut.lumi, views[0].lumi[:, 3:19, 5:23])
    np.testing.assert_array_equal(cut.images, views[0].images[:, 3:19, 5:23])


def test_examples_speak_the_runtime_s_language(views) -> None:
    _, sample = pairs(views, "replace", 1)[0]
    light, mask = draw(np.random.default_rng(0), NumpyOps(), sample)
    shots = Shots.of(sample, Camera(), np.random.default_rng(0))
    made = example(sample, shots, (light, mask), "relight")
    photo = NumpyOps().decode_srgb(NumpyOps().encode_srgb(sample.photo, np.uint8))
    encoded = NumpyOps().encode_srgb(photo, np.float32)
    condition = mini.encode(encoded, Strokes(light, mask), "relight")
    for name in ("photo", "light", "mask"):
        np.testing.assert_allclose(made[name][None], condition[name], atol=1e-5)
    assert int(made["mode"]) == mini.MODES["relight"]
    shown = made["photo"] + made["x0"] / 4
    relit = NumpyOps().encode_srgb(sample.relit, np.float32)
    np.testing.assert_allclose(shown.permute(1, 2, 0), relit, atol=0.6 / 255)  # the photo's own rounding
    estimate = example(sample, shots, None, "estimate")
    assert not estimate["mask"].any() and not estimate["light"].any()
    assert int(estimate["mode"]) == mini.MODES["estimate"]
    found = decode_lumi((estimate["x0"] + 1) / 2).permute(1, 2, 0)
    np.testing.assert_allclose(found, sample.source, rtol=1e-3, atol=1e-5)


def test_a_camera_s_flaws_stay_where_light_does_not_change(views) -> None:
    _, sample = pairs(views, "keep", 1)[0]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shots = Shots.of(sample, random_camera(rng), rng)
        assert not shots.change.any()


def test_local_changes_leave_more_of_the_picture(views) -> None:
    def still(kind: str) -> float:
        shares = []
        for _, sample in pairs(views, kind, 60):
            change = np.abs(sample.relit - sample.photo).max(axis=2)
            shares.append(np.mean(change <= 0.05 * change.max()))
        return float(np.mean(shares))

    assert still("dab") > still("change") + 0.1 and still("local") > still("change") + 0.1


def test_at_a_lone_dab_pictures_and_maps_change_by_one_factor(views) -> None:
    stops = []
    for _, sample in pairs(views, "dab"):
        whole = (sample.photo < 1) & (sample.relit < 1)
        one, other = sample.relit * sample.source, sample.photo * sample.target
        np.testing.assert_allclose(one[whole], other[whole], rtol=1e-3, atol=1e-6)
        stops.append(np.log2((sample.target + 1e-3) / (sample.source + 1e-3)))
    assert max(change.max() for change in stops) > 1 and min(change.min() for change in stops) < -1


def test_flags_let_light_pass_in_one_part() -> None:
    for seed in range(20):
        passing = flag(np.random.default_rng(seed), (48, 64), (0.15, 0.6))
        assert passing.shape == (48, 64) and passing.dtype == np.float32
        assert passing.min() >= 0 and 0.5 < passing.max() <= 1
    wide, narrow = (
        np.mean([flag(np.random.default_rng(k), (48, 64), PARTS[kind]).mean() for k in range(20)])
        for kind in ("local", "dab")
    )
    assert narrow < 0.6 * wide


def test_lone_strokes_are_for_single_places(views) -> None:
    counts = {kind: [] for kind in KINDS}
    for kind in KINDS:
        for k, (_, sample) in enumerate(pairs(views, kind, 60)):
            _, mask = draw(np.random.default_rng(k), NumpyOps(), zoomed(sample, (64, 64)))
            counts[kind].append(label(mask)[1])
    alone = {kind: np.mean(np.array(found) == 1) for kind, found in counts.items()}
    assert alone["dab"] == 1 and alone["replace"] < 0.5


def batch(views, number: int, **options) -> dict[str, torch.Tensor]:
    return next(iter(Batches(views, 3, **{"seed": 4, "start": number, **options})))


def same(one: dict, other: dict) -> bool:
    return all(one[name].shape == other[name].shape and torch.equal(one[name], other[name]) for name in one)


def test_batches_repeat_by_number_and_differ_between_numbers_seeds_and_ranks(views) -> None:
    stream = iter(Batches(views, 3, seed=4))
    first, second, third = (next(stream) for _ in range(3))
    assert same(third, batch(views, 2)) and same(first, batch(views, 0))
    others = second, batch(views, 0, seed=5), batch(views, 0, rank=1)
    assert not any(same(first, other) for other in others)


def test_batches_have_the_network_s_shapes_and_ranges(views) -> None:
    shapes = set()
    for number in range(8):
        made = batch(views, number)
        height, width = made["photo"].shape[2:]
        shapes.add((height, width))
        assert (height, width) in GRIDS
        assert made["photo"].shape == made["light"].shape == made["x0"].shape == (3, 3, height, width)
        assert made["mask"].shape == (3, 1, height, width) and made["mode"].shape == (3,)
        assert made["mode"].dtype == torch.int64 and made["x0"].dtype == torch.float32
        assert made["photo"].min() >= 0 and made["photo"].max() <= 1 and made["light"].min() >= 0
        assert made["x0"].isfinite().all()
        bytes_of = made["photo"] * 255
        torch.testing.assert_close(bytes_of, bytes_of.round(), atol=1e-3, rtol=0)
    assert len(shapes) > 1


def test_shares_say_how_many_estimate_and_how_many_draw_nothing(views) -> None:
    estimating = batch(views, 0, shares=Mix(estimate=1.0))
    assert (estimating["mode"] == 1).all() and not estimating["mask"].any()
    silent = batch(views, 0, shares=Mix(estimate=0.0, null=1.0))
    assert (silent["mode"] == 0).all() and not silent["mask"].any()
    drawn = batch(views, 0, shares=Mix(estimate=0.0, null=0.0))
    assert (drawn["mode"] == 0).all() and drawn["mask"].flatten(1).any(dim=1).all()
    kept = drawn["photo"] + drawn["x0"] / 4
    assert kept.min() > -0.2 and kept.max() < 1.2  # in range, but for the camera's flaws
    assert float(linear_to_srgb(torch.tensor(1.0))) == pytest.approx(1)


def test_a_brush_lays_one_colour_a_stroke() -> None:
    lumi = np.random.default_rng(0).uniform(0, 2, (8, 12, 3)).astype(np.float32)
    mask = np.zeros((8, 12), np.float32)
    mask[1:3, 1:4], mask[5:8, 6:12] = 1, 1
    laid = flat(lumi, mask)
    np.testing.assert_allclose(
        laid[1:3, 1:4], np.broadcast_to(lumi[1:3, 1:4].mean((0, 1)), (2, 3, 3)), rtol=1e-5
    )
    np.testing.assert_allclose(laid[5:, 6:], np.broadcast_to(lumi[5:, 6:].mean((0, 1)), (3, 6, 3)), rtol=1e-5)
    assert not laid[mask == 0].any()


def test_a_dab_is_one_round_touch_where_interest_lies() -> None:
    wanted = np.zeros((40, 60), np.float32)
    wanted[10, 45] = 1
    areas = []
    for seed in range(20):
        mask = dab(np.random.default_rng(seed), wanted)
        rows, columns = np.nonzero(mask)
        assert mask[10, 45] == 1 and label(mask)[1] == 1
        assert abs(rows.mean() - 10) < 0.6 and abs(columns.mean() - 45) < 0.6
        areas.append(mask.sum() / np.pi)
    radii = np.sqrt(areas) / 40
    assert radii.min() > 0.03 and radii.max() < 0.17 and radii.max() > 1.5 * radii.min()


@pytest.mark.parametrize("kind", ["change", "local", "replace"])
def test_only_where_asked_for_may_light_burn_the_picture_out(views, kind: str) -> None:
    def whites(burnt: bool) -> np.ndarray:
        made = [pair(np.random.default_rng(k), views[k % len(views)], kind, burnt=burnt) for k in range(60)]
        return np.array([np.mean(sample.relit.max(axis=2) >= 1) for sample in made])

    assert whites(burnt=True).mean() > 1.3 * whites(burnt=False).mean()


def test_a_white_balance_tints_pictures_and_maps_alike(views) -> None:
    fine = replace(views[0], images=views[0].images.astype(np.float32), lumi=views[0].lumi.astype(np.float32))
    balance = np.array([1.2, 1.0, 0.8], np.float32)
    tinted = pair(np.random.default_rng(3), fine, "keep", balance=balance)
    plain = pair(np.random.default_rng(3), fine, "keep")
    ratio = (tinted.source.sum(axis=(0, 1)) / plain.source.sum(axis=(0, 1))) / balance
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)  # but for the exposure
    unclipped = (tinted.photo < 0.99) & (plain.photo < 0.99) & (plain.photo > 0.01)
    shares = (tinted.photo / (plain.photo * balance + 1e-9))[unclipped]
    np.testing.assert_allclose(shares, ratio[0], rtol=1e-3)
