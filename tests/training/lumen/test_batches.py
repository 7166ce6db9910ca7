"""Batches made on the device hold what physics and the blend modes promise."""

from __future__ import annotations

import numpy as np
import pytest

from dior_rt.training.lumen import batches
from dior_rt.training.lumen.batches import KEEP, LOCAL, BatchMaker, mix
from dior_rt.training.lumen.brush import distance
from dior_rt.training.lumen.lamps import lamp_light
from dior_rt.training.lumen.materials import factors
from dior_rt.training.lumen.strokes import ADD, MULTIPLY, SET
from dior_rt.training.lumen.views import Views

torch = pytest.importorskip("torch")
COUNT = 48


@pytest.fixture(scope="module")
def batch(views: Views) -> batches.Batch:
    return BatchMaker(views, COUNT, seed=3).make(0)


def test_a_batch_is_the_same_on_every_run(views: Views, batch: batches.Batch) -> None:
    again = BatchMaker(views, COUNT, seed=3).make(0)
    assert torch.equal(again.photo, batch.photo)
    assert torch.equal(again.truth.target, batch.truth.target)
    assert not torch.equal(BatchMaker(views, COUNT, seed=3).make(1).photo, batch.photo)


def test_photos_have_eight_bits(batch: batches.Batch) -> None:
    codes = batch.photo * 255
    assert float((codes - codes.round()).abs().max()) < 1e-3
    assert 0 <= float(batch.photo.min()) <= float(batch.photo.max()) <= 1


def test_everything_is_finite_and_light_is_not_negative(batch: batches.Batch) -> None:
    for name, values in vars(batch.truth).items():
        assert bool(values.isfinite().all()), name
    assert float(batch.truth.light.min()) >= 0
    assert float(batch.truth.target.min()) >= -1e-5


def test_added_lamps_never_darken(batch: batches.Batch) -> None:
    added = batch.strokes.blend == ADD
    assert bool(added.any())
    assert float((batch.truth.target - batch.truth.light)[added].min()) > -1e-4


def test_drawn_values_are_the_light_in_the_mean(batch: batches.Batch) -> None:
    """Under all strokes together, the drawn light is what the blend mode says."""
    light, target, mask = batch.truth.light, batch.truth.target, batch.strokes.mask
    means = {
        SET: target,
        ADD: target - light,
        MULTIPLY: (target + 0.01) / (light + 0.01),
    }
    for mode, value in means.items():
        chosen = (batch.strokes.blend == mode) & (mask.mean(dim=(1, 2, 3)) < 0.5) & (batch.kind != LOCAL)
        for k in torch.nonzero(chosen)[:, 0].tolist():
            drawn = (batch.strokes.drawn * mask)[k].sum(dim=(1, 2))
            right = (value * mask)[k].sum(dim=(1, 2))
            assert torch.allclose(drawn, right, rtol=0.12, atol=0.05 * float(mask[k].sum())), (mode, k)


def test_nothing_changes_where_the_light_is_kept(batch: batches.Batch) -> None:
    kept = batch.kind == KEEP
    assert bool(kept.any())
    assert torch.equal(batch.truth.target[kept], batch.truth.light[kept])
    assert torch.allclose(batch.truth.relit[kept], batch.truth.style[kept], atol=1e-6)


def test_a_local_lamp_spares_the_wall_behind(views: Views) -> None:
    """A dab on the ball changes the ball more than the wall at the same distance in the picture."""
    inside, outside = [], []
    for number in range(4):
        batch = BatchMaker(views, COUNT, seed=5).make(number)
        change = (batch.truth.target - batch.truth.light).abs().amax(dim=1)
        ball = batch.truth.depth[:, 0] < np.log(3.9)
        wall = (batch.truth.sky[:, 0] == 0) & ~ball
        for k in torch.nonzero(batch.kind == LOCAL)[:, 0].tolist():
            mask = batch.strokes.mask[k, 0] > 0
            if not bool(ball[k][mask].all()) or int(mask.sum()) < 20:
                continue
            y, x = (part.float().mean() for part in torch.nonzero(mask, as_tuple=True))
            rows, columns = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
            ring = ((rows - y) ** 2 + (columns - x) ** 2).sqrt()
            near = (ring > 8) & (ring < 16)
            if int((near & ball[k]).sum()) > 10 and int((near & wall[k]).sum()) > 10:
                inside.append(float(change[k][near & ball[k]].mean()))
                outside.append(float(change[k][near & wall[k]].mean()))
    assert len(inside) >= 4
    assert np.mean(outside) < 0.5 * np.mean(inside)


def test_mixing_agrees_with_numpy(views: Views) -> None:
    maker = BatchMaker(views, 4, seed=0)
    scenery = maker._scenery()
    lights = torch.rand(4, 8, 3)
    picture, lumi = mix(scenery, lights)
    right = np.einsum("bkchw,bkc->bchw", scenery.images.numpy(), lights.numpy())
    assert np.allclose(picture.numpy(), right, rtol=1e-4, atol=1e-5)
    right = np.einsum("bkchw,bkc->bchw", scenery.lumi.numpy(), lights.numpy())
    assert np.allclose(lumi.numpy(), right, rtol=1e-4, atol=1e-5)


def test_a_lamp_falls_with_the_square_of_the_distance() -> None:
    position = torch.zeros(1, 3, 1, 2)
    position[0, 2, 0] = torch.tensor([0.0, -1.0])  # one and two before the lamp
    normal = torch.tensor([0.0, 0.0, 1.0])[None, :, None, None].expand(1, 3, 1, 2)
    light = lamp_light(position, normal, torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1))
    assert torch.allclose(light[0, 0, 0], torch.tensor([1.0, 0.25]))


def test_distance_to_a_line() -> None:
    points = torch.tensor([[[2.5, 2.5], [6.5, 2.5]]])
    away = distance(points, 8, 10)[0]
    assert float(away[2, 4]) == pytest.approx(0, abs=1e-3)
    assert float(away[5, 4]) == pytest.approx(3, abs=1e-3)
    assert float(away[2, 9]) == pytest.approx(3, abs=1e-3)


def test_new_materials_are_constant_on_an_object_and_spare_the_sky() -> None:
    ids = torch.zeros(16, 1, 8, 8, dtype=torch.uint8)
    ids[:, :, :, 4:], ids[:, :, :2] = 7, 255
    factor = factors(
        ids.float(), torch.zeros(0, 3, 128, 128, dtype=torch.uint8), torch.Generator().manual_seed(1)
    )
    assert torch.equal(factor[:, :, :2], torch.ones(16, 3, 2, 8))
    assert float(factor[:, :, 2:, 4:].std(dim=(2, 3)).max()) < 1e-6
    assert float(factor[:, :, 4, 5].std()) > 0.1
