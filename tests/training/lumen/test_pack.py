"""Shards keep what training needs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dior_rt.errors import InputError
from dior_rt.training.light import linear_to_srgb
from dior_rt.training.lumen.pack import SKY, load_shards, sheet, tiles_of, write_shards
from dior_rt.training.lumen.views import Views, from_code, to_code
from tests.training.lumen.balls import ball

torch = pytest.importorskip("torch")


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    def shown(linear: np.ndarray) -> np.ndarray:
        return linear_to_srgb(torch.from_numpy(linear).clamp(0, 1)).numpy()

    return float(-10 * np.log10(np.mean((shown(one) - shown(other)) ** 2)))


def test_codes_step_by_at_most_two_and_a_half_percent() -> None:
    light = torch.linspace(0.01, 1, 5000)
    back = from_code(to_code(light, torch.tensor(1.0)), torch.tensor(1.0))
    assert float(((back - light) / light).abs().max()) < 0.025


def test_sheets_return_their_tiles() -> None:
    tiles = np.random.default_rng(0).integers(0, 255, (7, 16, 16, 3), dtype=np.uint8)
    assert np.array_equal(tiles_of(sheet(tiles), 16)[:7], tiles)


def test_a_mixed_pair_keeps_38_db(views: Views) -> None:
    """Pictures of sharp synthetic edges are harder than renders, which keep 40 dB."""
    weights = np.array([0.8, 0.3, 0.0, 0.5], np.float32)[:, None, None, None]
    for number in range(len(views)):
        true = ball(number)
        images = from_code(views.images[number], views.image_most[number][:, None, None, None])[:4]
        lumi = from_code(views.lumi[number], views.lumi_most[number][:, None, None, None])[:4]
        for packed, right in ((images, true.images), (lumi, true.lumi)):
            mixed = (packed.permute(0, 2, 3, 1).numpy() * weights).sum(axis=0)
            assert psnr(mixed, (right * weights).sum(axis=0)) > 38


def test_scene_maps_survive(views: Views) -> None:
    true = ball(0)
    assert np.array_equal(views.ids[0, 0].numpy() == SKY, true.sky)
    ground = ~true.sky
    normal = views.normal[0].permute(1, 2, 0).numpy() / 127.5 - 1
    assert np.median((normal * true.normal).sum(axis=2)[ground]) > 0.98
    near, far = views.depth_range[0].tolist()
    depth = np.exp(near + views.depth[0, 0].numpy() / 255 * (far - near))
    assert np.median(np.abs(depth - true.depth)[ground]) < 0.02


def test_no_shard_is_larger_than_asked(tmp_path: Path) -> None:
    paths = write_shards((ball(seed) for seed in range(4)), tmp_path, largest=20_000)
    assert len(paths) > 1
    assert all(path.stat().st_size <= 20_000 for path in paths)
    assert len(load_shards(tmp_path)) == 4


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no shards"):
        load_shards(tmp_path)
