"""The LoRA on Qwen: mini's triplets, loss and loop, on a tiny random model."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_qwen
import torch
from agreement_qwen import AREA, RECIPE, call_both
from PIL import Image
from safetensors.torch import load_file

from dior_rt.cli import run
from dior_rt.errors import InputError
from dior_rt.export.qwen.bundle import export_qwen
from dior_rt.export.qwen.lora import Lora
from dior_rt.families.mini import MODES
from dior_rt.families.qwen.model import Qwen
from dior_rt.kernels import NumpyOps, Strokes
from dior_rt.light import LUMI_PEAK
from dior_rt.training import qwen as training
from dior_rt.training.data.render import View
from dior_rt.training.data.triplets import Batches, load_views
from dior_rt.training.fit import Plan, flow_loss
from dior_rt.training.light import draw_lumi, pack_patches, undraw_lumi, unpack_patches
from dior_rt.training.stage2 import MixedBatches, Mixture, fit_stage2, load_scenes, with_estimated_strokes

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


@pytest.mark.slow
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
    tokens = torch.cat([pack_patches(seen[name][0]) for name in ("photo", "light")]).numpy()
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
        references = torch.cat([pack_patches(picture[0]) for picture in pictures]).numpy()
        from dior_rt.families.qwen.frame import Frame
        from dior_rt.families.qwen.model import Condition

        sizes = ((4, 4),) * (1 + len(pictures))
        condition = Condition(mode, (64, 64), Frame.around((64, 64), 32), references, sizes, ())
        rows = qwens[True].modulation(np.array([0.5], np.float32))
        text = prompts[MODES[mode]].numpy()
        got = qwens[True].predict(pack_patches(x[0]).numpy(), condition, [text], rows)[0]
        np.testing.assert_allclose(got, pack_patches(want[0]).numpy(), atol=1e-4)


def test_tokens_are_unpacked_to_what_was_packed():
    latents = torch.randn(4, 6, 10)
    assert torch.equal(unpack_patches(pack_patches(latents), (3, 5)), latents)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """A scene of three photos: one surface under one light after another."""
    folder, random = tmp_path_factory.mktemp("pairs"), np.random.default_rng(1)
    surface = smooth(random, 72)
    (folder / "room").mkdir()
    for k in range(3):
        photo = NumpyOps().encode_srgb(surface * smooth(random, 72), np.uint8)
        Image.fromarray(photo).save(folder / "room" / f"{k}.png")
    return folder


@pytest.mark.slow
def test_stage_two_lowers_the_loss_on_real_pairs_it_has_not_drawn(
    folders, renders, pairs, trained, prompts, tmp_path
):
    # From the LoRA of stage 1, under strokes of the model's own, by the code that trains mini.
    file, scenes = trained / "pytorch_lora_weights.safetensors", load_scenes(pairs)
    plan = Plan(steps=10, batch=4, rate=2e-3, warmup=1, average=1, save_every=100)

    def backbone(start):
        return training.QwenLora(folders[True], tmp_path / "lora", 4, prompts, 64 * 64, start)

    losses = []
    fit_stage2(
        lambda: backbone(file),
        renders,
        scenes,
        tmp_path / "lora",
        plan,
        Mixture(rendered_weight=0.5, estimate_steps=2),
        lambda step, loss: losses.append(loss),
    )
    assert len(losses) == 10 and np.isfinite(losses).all()
    unseen = MixedBatches(scenes, Batches(load_views(renders), 2, seed=9), (77,), 0, 0.5)
    before = backbone(file)
    asked = with_estimated_strokes(before, next(iter(unseen)), 2, plan.shift)
    given = before.prepare(asked)
    noise = torch.randn(given["x0"].shape, generator=torch.Generator().manual_seed(0))

    def loss(network):
        with torch.no_grad():
            return float(flow_loss(network, given, torch.tensor([1.0, 0.9, 1.0, 0.8]), noise))

    after = backbone(tmp_path / "lora" / "pytorch_lora_weights.safetensors")
    assert loss(after.network) < 0.99 * loss(before.network)


def test_light_that_was_drawn_is_read_back():
    light = torch.rand(2, 3, 4, 4) * LUMI_PEAK
    torch.testing.assert_close(undraw_lumi(draw_lumi(light)), light, rtol=1e-4, atol=1e-5)


def test_latents_are_decoded_to_what_diffusers_paints():
    vae = tiny_qwen.vae()
    pictures = training.Pictures(vae, 64 * 64)
    latents = pictures.encode(torch.rand(2, 3, 64, 64))
    raw = latents * pictures.std + pictures.mean
    with torch.no_grad():
        want = (vae.decode(raw[:, :, None]).sample[:, :, 0] + 1) / 2
    torch.testing.assert_close(pictures.decode(latents), want.clamp(0, 1), rtol=1e-4, atol=1e-5)


def test_training_goes_on_from_a_lora_of_its_own_and_from_no_other(folders, trained, prompts, tmp_path):
    file = trained / "pytorch_lora_weights.safetensors"
    made = training.QwenLora(folders[True], tmp_path / "out", 4, prompts, start=file)
    made.save(made.network)
    again, first = (load_file(folder / file.name) for folder in (tmp_path / "out", trained))
    assert again.keys() == first.keys()
    assert all(torch.equal(again[name], first[name]) for name in first)
    with pytest.raises(InputError, match="it is of other layers, or of another rank"):
        training.QwenLora(folders[True], tmp_path / "other", 3, prompts, start=file)
    with pytest.raises(InputError, match="Cannot go on from the LoRA"):
        training.QwenLora(folders[True], tmp_path / "other", 4, prompts, start=tmp_path / "none")


@pytest.mark.usefixtures("another_precision")
def test_half_the_memory_trains_a_lora_in_single_precision(folders, renders, prompts, tmp_path):
    plan = Plan(steps=2, batch=2, rate=2e-3, warmup=1, save_every=100, precision="bf16")
    losses = []
    training.fit_qwen_lora(
        folders[True], renders, tmp_path, 2, plan, prompts, 64 * 64, lambda step, loss: losses.append(loss)
    )
    assert np.isfinite(losses).all()
    weights = load_file(tmp_path / "pytorch_lora_weights.safetensors")
    assert {weight.dtype for weight in weights.values()} == {torch.float32}
    beneath = training.QwenLora(folders[True], tmp_path, 2, prompts, dtype=torch.bfloat16).network
    kept = {weight.dtype for name, weight in beneath.named_parameters() if "transformer_blocks" in name}
    assert kept == {torch.bfloat16, torch.float32}


@pytest.mark.slow
def test_the_commands_train_resume_and_export(folders, renders, pairs, tmp_path, capfd):
    model, first, second = str(folders[True]), tmp_path / "first", tmp_path / "second"
    small = ["--side", "64", "--rank", "2", "--batch", "2"]
    assert run(["train", "qwen-lora", model, str(renders), "--out", str(first), "--steps", "1", *small]) == 0
    capfd.readouterr()
    assert run(["train", "qwen-lora", model, str(renders), "--out", str(first), "--steps", "2", *small]) == 0
    assert "step 2/2" in capfd.readouterr().err
    start = ["--start", str(first / "pytorch_lora_weights.safetensors")]
    asked = [model, str(renders), str(pairs), "--out", str(second), "--steps", "1", *small, *start]
    assert run(["train", "stage2", *asked]) == 0
    lora = str(second / "pytorch_lora_weights.safetensors")
    merged = ["--lora", lora, "--prompt-cache", "--few-steps", "2", "--weights", "fp32"]
    assert run(["export", model, "-o", str(tmp_path / "bundle"), *merged]) == 0
    assert (tmp_path / "bundle" / "manifest.json").is_file()


def test_commands_say_in_one_sentence_what_they_cannot_use(folders, renders, pairs, tmp_path, capfd):
    model, out, none = str(folders[True]), tmp_path / "out", str(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    for arguments, saying in (
        (["qwen-lora", model, none], "There are no renders in"),
        (["qwen-lora", none, str(renders)], "Cannot read the text encoder in"),
        (["stage2", model, str(renders), none], "Cannot read the folder of pairs"),
        (["stage2", model, str(renders), str(tmp_path / "empty")], "There are no scenes in"),
        (["stage2", model, str(renders), str(pairs), "--batch", "3"], "must be even"),
        (["stage2", model, str(renders), str(pairs), "--photos", "*.exr"], "a pair takes two"),
        (["stage2", none, str(renders), str(pairs), "--start", "x"], "is no Qwen-Image-Edit"),
        (["stage2", none, str(renders), str(pairs)], "Cannot read the checkpoint"),
    ):
        assert run(["train", *arguments, "--out", str(out)]) == 2
        said = capfd.readouterr().err
        assert said.count("\n") == 1 and said.startswith("dior-rt: ") and saying in said, said
        assert not out.exists()


def test_a_folder_that_is_no_model_is_refused(renders, prompts, tmp_path):
    with pytest.raises(InputError, match="Cannot read the model"):
        training.fit_qwen_lora(tmp_path, renders, tmp_path / "out", 4, Plan(steps=1), prompts)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="Cannot read the text encoder"):
        training.embed_prompts(tmp_path, SAID)
