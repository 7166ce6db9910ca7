"""A lumen network becomes a bundle that the runtime relights with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dior_rt import Relighter
from dior_rt.families.lumen import log_ratio
from dior_rt.kernels import Strokes

torch = pytest.importorskip("torch")

from dior_rt.export.lumen import LumenExportConfig, export_network  # noqa: E402
from dior_rt.training.light import linear_to_srgb  # noqa: E402
from dior_rt.training.lumen import shading  # noqa: E402
from dior_rt.training.lumen.completion import Strokes as Drawn  # noqa: E402
from dior_rt.training.lumen.config import LumenConfig  # noqa: E402
from dior_rt.training.lumen.model import Lumen  # noqa: E402


def test_the_quotient_of_lights_is_that_of_training() -> None:
    rng = np.random.default_rng(0)
    source, target = (rng.random((2, 3, 24, 40), dtype=np.float32) for _ in range(2))
    bounce = rng.random((2, 2, 24, 40), dtype=np.float32)
    right = shading.log_ratio(*map(torch.from_numpy, (source, target, bounce, np.zeros_like(source))))
    assert np.allclose(log_ratio(source, target, bounce), right.numpy(), atol=1e-5)


@pytest.mark.slow
def test_the_runtime_relights_as_torch_does(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = Lumen(
        LumenConfig(width=32, heads=1, scene_depth=1, light_depth=1, fine=16, half=16, quarter=16)
    )
    for head in (network.scene.light, network.light.head):
        torch.nn.init.normal_(head.weight, std=0.05)
    config = LumenExportConfig()
    bundle = export_network(network.eval(), tmp_path / "bundle", config)
    assert bundle.manifest.parity["evaluation"] < 1e-3
    relighter = Relighter(bundle.folder, device="cpu", ops="numpy")
    rng = np.random.default_rng(1)
    # A photo of the grid's own size: the transfer to the full size is then next to nothing.
    size = config.grid.shape(128, 128)
    photo = np.repeat(np.repeat(rng.random((size[0] // 8, size[1] // 8, 3)), 8, axis=0), 8, axis=1).astype(
        np.float32
    )
    light, mask = np.full((*size, 3), 1.5, np.float32), np.zeros(size, np.float32)
    mask[40:70, 30:80] = 1
    relit = relighter.relight(photo, Strokes(light, mask), steps=1).picture
    planes = torch.from_numpy(photo.transpose(2, 0, 1)[None])
    strokes = Drawn(
        torch.from_numpy((light * mask[..., None]).transpose(2, 0, 1)[None]),
        torch.from_numpy(mask[None, None]),
        torch.zeros(1, dtype=torch.long),
        torch.zeros(1, dtype=torch.long),
    )
    with torch.no_grad():
        _, _, right = network(torch.zeros_like(planes), torch.ones(1), planes, strokes)
    found = np.asarray(relit).clip(0, 1)[8:-8:16, 8:-8:16]
    right = linear_to_srgb(right.clamp(0, 1))[0].permute(1, 2, 0).numpy()[8:-8:16, 8:-8:16]
    assert np.abs(found - right).mean() < 0.02
    estimate = relighter.estimate(photo)
    with torch.no_grad():
        scene = network.scene(planes)
    assert np.allclose(estimate, scene.light[0].permute(1, 2, 0).numpy(), rtol=0.05, atol=0.02)
