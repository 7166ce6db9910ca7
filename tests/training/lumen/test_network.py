"""The guarantees of the untrained network."""

from __future__ import annotations

from pathlib import Path

import pytest

from dior_rt.errors import InputError
from dior_rt.training.light import srgb_to_linear
from dior_rt.training.lumen.batches import Batch, BatchMaker
from dior_rt.training.lumen.checkpoint import load_lumen, save_lumen
from dior_rt.training.lumen.completion import Completed, Strokes, hold
from dior_rt.training.lumen.loss import loss
from dior_rt.training.lumen.model import Lumen
from dior_rt.training.lumen.optics import blur, double, luminance
from dior_rt.training.lumen.shading import log_ratio, relight
from dior_rt.training.lumen.strokes import ADD, MULTIPLY, SET
from dior_rt.training.lumen.views import Views

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def batch(views: Views) -> Batch:
    return BatchMaker(views, 6, seed=0).make(0)


def answer(network: Lumen, batch: Batch, strokes: Strokes) -> tuple[Completed, torch.Tensor]:
    count = len(batch.photo)
    with torch.no_grad():
        x, sigma = torch.zeros_like(batch.truth.x0), torch.ones(count)
        _, completed, relit = network(x, sigma, batch.photo, strokes)
    return completed, relit


def drawn(batch: Batch, value: float, blend: int) -> Strokes:
    count = len(batch.photo)
    mask = torch.zeros_like(batch.photo[:, :1])
    mask[:, :, 20:40, 24:44] = 1
    light = torch.full_like(batch.photo, value) * mask
    return Strokes(light, mask, torch.full((count,), blend), torch.zeros(count, dtype=torch.long))


def test_without_strokes_the_photo_comes_back(network: Lumen, batch: Batch) -> None:
    for blend in (SET, ADD, MULTIPLY):
        strokes = drawn(batch, 1.0, blend)
        _, relit = answer(network, batch, strokes._replace(mask=torch.zeros_like(strokes.mask)))
        assert torch.allclose(relit, srgb_to_linear(batch.photo), atol=1e-5)


def test_added_light_is_linear_and_never_darkens(network: Lumen, batch: Batch) -> None:
    one, relit = answer(network, batch, drawn(batch, 0.5, ADD))
    four, _ = answer(network, batch, drawn(batch, 2.0, ADD))
    none, _ = answer(network, batch, drawn(batch, 0.0, ADD))
    assert torch.allclose(four.target - none.target, 4 * (one.target - none.target), rtol=1e-3, atol=1e-4)
    assert float((relit - srgb_to_linear(batch.photo)).min()) > -1e-5


def test_a_factor_holds_under_its_stroke_whatever_the_estimate(network: Lumen, batch: Batch) -> None:
    completed, _ = answer(network, batch, drawn(batch, 0.25, MULTIPLY))
    inner = completed.factor[:, :, 26:34, 30:38]
    assert torch.allclose(torch.exp(inner), torch.full_like(inner, 0.25), rtol=0.03)


def test_twice_the_drawn_light_is_twice_the_light_under_the_stroke(network: Lumen, batch: Batch) -> None:
    levels = [answer(network, batch, drawn(batch, value, SET))[0].target for value in (0.25, 1.0, 4.0)]
    means = [level[:, :, 24:36, 28:40].mean(dim=(1, 2, 3)) for level in levels]
    for value, mean in zip((0.25, 1.0, 4.0), means, strict=True):
        assert torch.allclose(mean, torch.full_like(mean, value), rtol=0.1)


def test_held_light_keeps_its_form() -> None:
    """Shading under a stroke stays in proportion; its mean becomes what was drawn."""
    form = 1 + 0.4 * torch.sin(torch.arange(64.0) * 2.2)[None, None, None].expand(1, 3, 64, 64)
    mask = torch.zeros(1, 1, 64, 64)
    mask[:, :, 16:48, 16:48] = 1
    held = hold(form, torch.full_like(form, 3.0), mask)
    inner = held[:, :, 26:38, 26:38]
    assert float(inner.mean()) == pytest.approx(3.0, rel=0.08)
    shape = form[:, :, 26:38, 26:38]
    assert float(((inner / inner.mean()) / (shape / shape.mean()) - 1).abs().max()) < 0.1
    assert torch.allclose(held[:, :, 0, 0], form[:, :, 0, 0], rtol=0.05)


def test_equal_lights_return_the_photo() -> None:
    photo, light = torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16)
    ratio = log_ratio(light, light, torch.rand(1, 2, 16, 16), torch.zeros_like(light))
    assert torch.allclose(relight(photo, ratio), srgb_to_linear(photo), atol=1e-6)


def test_light_colours_have_luminance_one(network: Lumen, batch: Batch) -> None:
    """The estimate's colour is a mixture of a few colours, the same for the whole photo."""
    with torch.no_grad():
        scene = network.scene(batch.photo)
    chroma = scene.light / luminance(scene.light).clamp_min(1e-4)
    pixels = chroma[0].flatten(1)
    rank = torch.linalg.svdvals(pixels - pixels.mean(dim=1, keepdim=True))
    assert bool(rank.isfinite().all())
    assert torch.allclose(luminance(chroma), torch.ones_like(chroma[:, :1]), atol=2e-2)


def test_double_is_bilinear() -> None:
    cells = torch.randn(2, 3, 6, 10)
    right = torch.nn.functional.interpolate(cells, scale_factor=2, mode="bilinear", align_corners=False)
    assert torch.allclose(double(cells), right, atol=1e-6)


def test_blur_keeps_a_constant() -> None:
    assert torch.allclose(
        blur(torch.full((1, 2, 12, 20), 0.7), 3.0), torch.full((1, 2, 12, 20), 0.7), atol=1e-6
    )


def test_every_weight_learns(network: Lumen, views: Views) -> None:
    batch = BatchMaker(views, 8, seed=1).make(0)
    x, sigma = torch.randn_like(batch.truth.x0), torch.full((8,), 0.5)
    scene, completed, relit = network.train()(x, sigma, batch.photo, batch.strokes)
    total, _ = loss(scene, completed, relit, batch)
    total.backward()
    silent = [
        name for name, weight in network.named_parameters() if weight.grad is None or not weight.grad.any()
    ]
    network.zero_grad()
    # These learn once the weights after them, which start at 0, have moved.
    later = (".first.", ".norm.", "light.time.", "light.mode.")
    assert not [name for name in silent if not any(part in name for part in later)]


def test_a_checkpoint_returns_the_same_network(network: Lumen, tmp_path: Path) -> None:
    save_lumen(network, tmp_path / "model.safetensors")
    loaded = load_lumen(tmp_path / "model.safetensors")
    for (name, one), (_, other) in zip(
        network.state_dict().items(), loaded.state_dict().items(), strict=True
    ):
        assert torch.equal(one, other), name


def test_a_file_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(InputError, match="no checkpoint"):
        load_lumen(tmp_path / "model.safetensors")
