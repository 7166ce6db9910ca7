"""Stage 2: real pairs of one view, under strokes that the model draws itself, beside rendered triplets."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from peft import PeftModel
from PIL import Image
from safetensors.torch import load_file

from dior_rt.cli import run
from dior_rt.errors import InputError
from dior_rt.export.lora import merge_lora
from dior_rt.kernels import NumpyOps
from dior_rt.training.backbone import MiniLora
from dior_rt.training.fit import STATE, Plan, fit, flow_loss, rendered
from dior_rt.training.light import RELIT_SCALE, decode_lumi, encode_lumi, srgb_to_linear
from dior_rt.training.network import LORA, WEIGHTS, Config, load_network
from dior_rt.training.stage2 import (
    MixedBatches,
    Mixture,
    Scene,
    estimate,
    fit_stage2,
    load_scenes,
    real_pair,
    with_estimated_strokes,
)

OPS = NumpyOps()
TINY = Config(width=32, depth=1, heads=2, fine=16, half=32, quarter=64)
PLAN = Plan(steps=1, batch=6)


def smooth(random, size: tuple[int, int]) -> np.ndarray:
    coarse = torch.from_numpy(random.uniform(0.1, 1, (1, 3, 4, 4)).astype(np.float32))
    fine = torch.nn.functional.interpolate(coarse, size, mode="bicubic").clamp(0.05, 1)
    return fine[0].permute(1, 2, 0).contiguous().numpy()


def save(path: Path, linear: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(OPS.encode_srgb(linear, np.uint8)).save(path)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory) -> Path:
    """Two scenes of three photos each: a surface under one light after another, the first of them dim."""
    folder, random = tmp_path_factory.mktemp("pairs"), np.random.default_rng(0)
    for scene, size in (("kitchen", (60, 90)), ("tower", (88, 66))):
        surface = smooth(random, size)
        for k in range(3):
            save(folder / scene / f"{k}.png", surface * smooth(random, size) * (0.1 if k == 0 else 1))
    return folder


@pytest.fixture(scope="module")
def stage1(renders, tmp_path_factory) -> Path:
    """The checkpoint of a short first stage."""
    out = tmp_path_factory.mktemp("stage1")
    fit(renders, out, TINY, Plan(steps=30, batch=6, rate=4e-3, warmup=5, average=5))
    return out / WEIGHTS


def mixed(pairs: Path, renders: Path, start: int = 0, weight: float = 1.0) -> MixedBatches:
    return MixedBatches(load_scenes(pairs), rendered(renders, PLAN)(start, 0), (3, 0), start, weight)


class Oracle:
    """A backbone that knows its answer: the light that it sees is twice the photo's own brightness."""

    class Flow(torch.nn.Module):
        def forward(self, x, sigma, photo, light, mask, mode):
            x0 = 2 * encode_lumi(2 * srgb_to_linear(photo)) - 1
            return (x - x0) / sigma[:, None, None, None]

    network = Flow()

    def prepare(self, batch):
        return batch

    def lumi(self, x0, grid):
        return decode_lumi((x0 + 1) / 2)

    def save(self, network):
        raise NotImplementedError


@pytest.mark.parametrize("size", [(60, 90), (200, 130), (20, 16)], ids=str)
def test_both_photos_of_a_pair_are_seen_through_one_window(tmp_path, size) -> None:
    # Twice the light at every place: the two would differ by another factor were they not aligned.
    surface = smooth(np.random.default_rng(1), size) / 2.5
    save(tmp_path / "a.png", surface)
    save(tmp_path / "b.png", 2 * surface)
    scene = Scene((tmp_path / "a.png", tmp_path / "b.png"))
    for seed in range(8):
        sample = real_pair(np.random.default_rng(seed), scene, (24, 32))
        assert sample["photo"].shape == sample["x0"].shape == (3, 24, 32)
        assert not sample["light"].any() and not sample["mask"].any() and int(sample["mode"]) == 0
        source = srgb_to_linear(sample["photo"])
        target = srgb_to_linear(sample["photo"] + sample["x0"] / RELIT_SCALE)
        ratio = (target / source).flatten()
        factor = 2 if ratio.mean() > 1 else 0.5
        assert ((ratio > 0.9 * factor) & (ratio < 1.1 * factor)).all()


def test_a_batch_is_half_real_and_half_rendered_and_its_number_fixes_it(pairs, renders) -> None:
    batches = list(islice(mixed(pairs, renders), 3))
    (again,) = islice(mixed(pairs, renders, start=2), 1)
    for name, value in batches[2].items():
        assert torch.equal(value, again[name])
    assert not torch.equal(batches[0]["photo"], batches[1]["photo"])
    for batch in batches:
        assert batch["real"].tolist() == [True] * 6 + [False] * 6
    (triplets,) = islice(rendered(renders, PLAN)(2, 0), 1)
    assert triplets.pop("own") is not None and "own" not in again  # of real pairs nobody knows it
    for name, value in triplets.items():
        assert torch.equal(value, again[name][6:])


@pytest.mark.parametrize("weight", [0.0, 1.0, 2.5])
def test_the_loss_is_the_real_mean_and_so_much_of_the_rendered(pairs, renders, weight) -> None:
    (batch,) = islice(mixed(pairs, renders, weight=weight), 1)
    network, sigma, noise = Oracle.network, torch.full((12,), 0.7), torch.randn(batch["x0"].shape)

    def loss(part: slice) -> torch.Tensor:
        half = {n: v[part] for n, v in batch.items() if n not in ("seed", "weight")}
        return flow_loss(network, half, sigma[part], noise[part])

    want = loss(slice(6)) + weight * loss(slice(6, None))
    torch.testing.assert_close(flow_loss(network, batch, sigma, noise), want)


@pytest.mark.parametrize("steps", [1, 3])
def test_real_pairs_are_driven_by_the_light_that_the_model_sees_in_their_target(
    pairs, renders, steps
) -> None:
    (batch,) = islice(mixed(pairs, renders), 1)
    drawn = with_estimated_strokes(Oracle(), batch, steps, shift=8.0)
    target = batch["photo"] + batch["x0"] / RELIT_SCALE
    light = 2 * srgb_to_linear(target)
    shares = []
    for k in range(6):
        mask = drawn["mask"][k, 0] > 0
        shares.append(float(mask.float().mean()))
        inside = drawn["light"][k][:, mask]
        assert mask.any() and inside.isfinite().all()
        if shares[-1] == 1:  # a dense map is the estimate itself
            torch.testing.assert_close(drawn["light"][k], light[k], rtol=1e-3, atol=1e-4)
        # A coarse cell holds a mean: within what the whole map holds.
        assert inside.max() <= light[k].max() * 1.01 and inside.min() >= light[k].min() * 0.99
    assert min(shares) < 1  # not all of them are dense
    for name in ("light", "mask"):
        assert torch.equal(drawn[name][6:], batch[name][6:])  # the rendered half keeps its own strokes
        assert not drawn[name].requires_grad


def test_no_gradient_flows_through_the_estimate(stage1, tmp_path, pairs, renders) -> None:
    backbone = MiniLora(stage1, 2, tmp_path)
    lumi = estimate(backbone, torch.rand(2, 3, 64, 64), 0, [1.0, 0.5, 0.0])
    assert lumi.shape == (2, 3, 64, 64) and (lumi >= 0).all() and not lumi.requires_grad
    # It is the network of now that is asked, not a copy of what it was.
    with torch.no_grad():
        for weight in backbone.network.parameters():
            if weight.requires_grad:
                weight += 0.1
    changed = estimate(backbone, torch.rand(2, 3, 64, 64), 0, [1.0, 0.5, 0.0])
    assert not torch.allclose(lumi, changed)


@pytest.fixture(scope="module")
def unseen(stage1, pairs, renders, tmp_path_factory):
    """A batch that training does not draw, under strokes by stage 1, and noise for it."""
    (batch,) = islice(mixed(pairs, renders, start=900), 1)
    backbone = MiniLora(stage1, 1, tmp_path_factory.mktemp("unused"))
    noise = torch.randn(batch["x0"].shape, generator=torch.Generator().manual_seed(0))
    return with_estimated_strokes(backbone, batch, 1, shift=8.0), noise


def losses_of(network: torch.nn.Module, unseen) -> list[float]:
    """On the real pairs, and on all with their weights."""
    batch, noise = unseen
    real = {name: value[:6] for name, value in batch.items() if name not in ("seed", "weight")}
    network.eval()
    with torch.no_grad():
        whole = flow_loss(network, batch, torch.ones(12), noise)
        return [float(flow_loss(network, real, torch.ones(6), noise[:6])), float(whole)]


@pytest.mark.slow
def test_it_learns_and_goes_on_where_it_stopped(stage1, pairs, renders, unseen, tmp_path) -> None:
    plan = Plan(steps=96, batch=8, rate=4e-3, warmup=2, average=4, save_every=8)
    through, stopped, scenes = tmp_path / "through", tmp_path / "stopped", load_scenes(pairs)

    def train(out: Path, progress=None) -> None:
        fit_stage2(lambda: MiniLora(stage1, 16, out), renders, scenes, out, plan, Mixture(), progress)

    train(through)
    trained = PeftModel.from_pretrained(load_network(through / WEIGHTS), str(through / LORA))
    before, after = losses_of(load_network(stage1), unseen), losses_of(trained, unseen)
    assert after[0] < 0.95 * before[0] and after[1] < 0.98 * before[1]

    def stop(step: int, loss: float) -> None:
        if step == 18:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(stopped, stop)
    seen = []
    train(stopped, lambda step, loss: seen.append(step))
    assert seen == list(range(17, plan.steps + 1))
    whole, resumed = load_file(through / STATE), load_file(stopped / STATE)
    for name, tensor in whole.items():
        torch.testing.assert_close(resumed[name], tensor, rtol=1e-4, atol=1e-6)


def test_folders_that_hold_no_pairs(tmp_path) -> None:
    with pytest.raises(InputError, match="Cannot read the folder of pairs"):
        load_scenes(tmp_path / "none")
    with pytest.raises(InputError, match="There are no scenes in"):
        load_scenes(tmp_path)
    random, scene = np.random.default_rng(0), tmp_path / "scene"
    save(scene / "a.png", smooth(random, (20, 30)))
    with pytest.raises(InputError, match=r"has 1 photos like '\*'; a pair takes two"):
        load_scenes(tmp_path)
    save(scene / "b.png", smooth(random, (20, 31)))
    with pytest.raises(InputError, match=r"of one view; .*a\.png and .*b\.png differ in size"):
        load_scenes(tmp_path)
    save(scene / "b.png", smooth(random, (20, 30)))
    (scene / "notes.txt").write_text("no photo")
    with pytest.raises(InputError, match=r"Cannot read the photo .*notes\.txt"):
        load_scenes(tmp_path)
    assert len(load_scenes(tmp_path, "*.png")[0].photos) == 2


def test_a_photo_that_breaks_while_training_is_named_in_one_sentence(stage1, renders, tmp_path) -> None:
    scene, out = tmp_path / "pairs" / "scene", tmp_path / "out"
    for name in ("a.png", "b.png"):
        save(scene / name, smooth(np.random.default_rng(0), (40, 60)))
    (scene / "b.png").write_bytes((scene / "b.png").read_bytes()[:-300])
    scenes = load_scenes(tmp_path / "pairs")  # its head is whole
    with pytest.raises(InputError, match=r"^Cannot read the photo [^\n]*b\.png[^\n]*$"):
        fit_stage2(lambda: MiniLora(stage1, 2, out), renders, scenes, out, Plan(steps=2, batch=2))


def test_an_odd_batch_has_no_halves(stage1, pairs, renders, tmp_path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="must be even; 5 is not"):
        fit_stage2(lambda: MiniLora(stage1, 2, out), renders, load_scenes(pairs), out, Plan(steps=1, batch=5))
    assert not out.exists()


def test_the_command_trains_what_export_takes(stage1, pairs, renders, tmp_path, capfd) -> None:
    out = tmp_path / "out"
    asked = ["train", "stage2", str(stage1), str(renders), str(pairs), "--out", str(out), "--rank", "2"]
    assert run([*asked, "--batch", "3"]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "must be even; 3 is not" in said and not out.exists()
    assert run([*asked, "--batch", "2", "--steps", "1", "--photos", "*.png", "--rendered-weight", "0.5"]) == 0
    assert sorted(path.name for path in out.iterdir()) == [LORA, WEIGHTS, STATE]
    merge_lora(load_network(out / WEIGHTS), out / LORA)
