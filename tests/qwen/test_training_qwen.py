"""The LoRA on Qwen: mini's triplets, loss and loop, on a tiny random model."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_qwen
import torch
from agreement_qwen import AREA, RECIPE, call_both

from dior_rt.errors import InputError
from dior_rt.export.qwen.bundle import export_qwen
from dior_rt.export.qwen.lora import Lora
from dior_rt.family.mini import MODES
from dior_rt.family.qwen import Qwen
from dior_rt.kernels import Strokes
from dior_rt.training import qwen as training
from dior_rt.training.fit import Plan, flow_loss
from dior_rt.training.render import View
from dior_rt.training.triplets import Batches, load_views

SAID = {MODES["relight"]: "light it from the left", MODES["estimate"]: "draw its light"}


@pytest.fixture(scope="module")
def renders(tmp_path_factory):
    """Views of smooth random light: three sources and a dome."""
    folder, random = tmp_path_factory.mktemp("renders"), np.random.default_rng(0)
    for number in range(2):
        lumi = np.stack([smooth(random) for _ in range(4)])
        lumi *= 0.25 / lumi.mean(axis=(1, 2, 3), keepdims=True)
        albedo = 0.2 + 0.6 * smooth(random)
        view = View(
            (lumi * albedo).astype(np.float16),
            lumi.astype(np.float16),
            ("point",) * 3 + ("dome",),
            "subject",
            number,
        )
        view.save(folder / f"{number:05}-0.npz")
    return folder


def smooth(random, side=128):
    coarse = random.uniform(0.05, 1, (4, 4, 3)).astype(np.float32)
    up = torch.nn.functional.interpolate(
        torch.from_numpy(coarse).permute(2, 0, 1)[None], (side, side), mode="bicubic"
    )
    return up[0].permute(1, 2, 0).clamp_min(0.02).numpy()


@pytest.fixture(scope="module")
def prompts(folders):
    return training.embed_prompts(folders[True], SAID)


@pytest.fixture(scope="module")
def trained(folders, renders, prompts, tmp_path_factory):
    """A LoRA of some steps, and the folder it lies in."""
    out = tmp_path_factory.mktemp("lora")
    losses = []
    plan = Plan(steps=12, batch=2, rate=2e-3, warmup=1, average=1, save_every=100)
    training.fit_qwen_lora(
        folders[True],
        renders,
        out,
        4,
        plan,
        prompts,
        area=64 * 64,
        progress=lambda step, loss: losses.append(loss),
    )
    assert len(losses) == 12
    return out


def batch_of(renders):
    return next(iter(Batches(load_views(renders), 4, seed=9, start=0, rank=0)))


def loss_of(transformer, prompts, batch):
    network = training.Qwen(transformer, prompts, 1)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(batch["x0"].shape, generator=generator)
    with torch.no_grad():
        return float(flow_loss(network, batch, torch.tensor([1.0, 0.9, 0.7, 0.4]), noise))


def test_training_lowers_the_loss_of_triplets_it_has_not_seen(trained, renders, prompts):
    batch = training.Pictures(tiny_qwen.vae(), 64 * 64).prepare(batch_of(renders))
    before = loss_of(tiny_qwen.transformer(), prompts, batch)
    pipe = tiny_qwen.pipeline()
    pipe.load_lora_weights(trained)
    pipe.fuse_lora()
    pipe.unload_lora_weights()
    after = loss_of(pipe.transformer, prompts, batch)
    assert after < 0.98 * before


def test_the_lora_it_writes_is_merged_by_the_export(trained, folders, tmp_path):
    path = trained / "pytorch_lora_weights.safetensors"
    pipe = tiny_qwen.pipeline()
    pipe.load_lora_weights(path)
    qwen = Qwen(export_qwen(folders[True], tmp_path / "bundle", RECIPE, loras=[Lora(path)]), "cpu")
    got, want = call_both(qwen, pipe, 0.5, 5, [(4, 4), (4, 4), (4, 4)])
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def test_only_the_lora_is_trained(prompts):
    network = training.Qwen(tiny_qwen.transformer(), prompts, 2)
    names = {name for name, weight in network.named_parameters() if weight.requires_grad}
    assert names and all("lora_" in name for name in names)
    # A and B of 8 projections and 4 layers of MLPs a block; but for the 4 whose result nobody reads.
    assert len(names) == 2 * (3 * 12 - 4)


def test_training_and_runtime_see_the_same_pictures(qwens, prompts):
    random = np.random.default_rng(0)
    photo = random.uniform(0, 1, (96, 96, 3)).astype(np.float32)
    photo = np.rint(photo * 255).astype(np.float32) / 255
    strokes = Strokes(
        random.uniform(0, 6, (96, 96, 3)).astype(np.float32),
        (random.uniform(size=(96, 96)) > 0.5).astype(np.float32),
    )
    condition = qwens[True].encode(photo, strokes, "relight")
    pictures = training.Pictures(tiny_qwen.vae(), AREA)
    planes = torch.from_numpy(photo).permute(2, 0, 1)[None]
    batch = {
        "photo": planes,
        "light": torch.from_numpy(strokes.light).permute(2, 0, 1)[None],
        "mask": torch.from_numpy(strokes.mask)[None, None],
        "mode": torch.tensor([MODES["relight"]]),
        "x0": torch.zeros_like(planes),
    }
    seen = pictures.prepare(batch)
    tokens = torch.cat([training.pack(seen[name][0]) for name in ("photo", "light")]).numpy()
    # The runtime rounds the drawing of light to 8 bits.
    np.testing.assert_allclose(tokens[:36], condition.references[:36], atol=1e-4)
    assert np.abs(tokens[36:] - condition.references[36:]).max() < 0.05 * np.abs(tokens).max()
    np.testing.assert_array_equal(seen["x0"].numpy(), seen["photo"].numpy())  # x0 of 0 is the photo itself


def test_training_and_runtime_ask_the_same_network(qwens, prompts):
    network = training.Qwen(tiny_qwen.transformer(), prompts, 1)
    random = np.random.default_rng(1)
    x, photo, light = (
        torch.from_numpy(random.standard_normal((1, 4, 8, 8), dtype=np.float32)) for _ in range(3)
    )
    for mode, pictures in (("relight", [photo, light]), ("estimate", [photo])):
        with torch.no_grad():
            want = network(x, torch.tensor([0.5]), photo, light, None, torch.tensor([MODES[mode]]))
        references = torch.cat([training.pack(picture[0]) for picture in pictures]).numpy()
        from dior_rt.family.qwen import Condition
        from dior_rt.family.qwen_frame import Frame

        sizes = ((4, 4),) * (1 + len(pictures))
        condition = Condition(mode, (64, 64), Frame.around((64, 64), 32), references, sizes, ())
        rows = qwens[True].modulation(np.array([0.5], np.float32))
        text = prompts[MODES[mode]].numpy()
        got = qwens[True].predict(training.pack(x[0]).numpy(), condition, [text], rows)[0]
        np.testing.assert_allclose(got, training.pack(want[0]).numpy(), atol=1e-4)


def test_tokens_are_unpacked_to_what_was_packed():
    latents = torch.randn(4, 6, 10)
    assert torch.equal(training.unpack(training.pack(latents), 3, 5), latents)


def test_a_folder_that_is_no_model_is_refused(renders, prompts, tmp_path):
    with pytest.raises(InputError, match="Cannot read the model"):
        training.fit_qwen_lora(tmp_path, renders, tmp_path / "out", 4, Plan(steps=1), prompts)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="Cannot read the text encoder"):
        training.embed_prompts(tmp_path, SAID)
