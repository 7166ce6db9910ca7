"""The export as a whole: its files and figures, its memory, and what it refuses."""

from __future__ import annotations

import json
import re
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import tiny_qwen
import torch
from agreement_qwen import RECIPE, call_both
from diffusers import FlowMatchEulerDiscreteScheduler
from diffusers.pipelines.qwenimage.pipeline_qwenimage_edit_plus import calculate_shift
from safetensors.torch import load_file, save_file

from dior_rt.bundle import read_bundle
from dior_rt.errors import BundleError, DiorError, InputError
from dior_rt.export.qwen.bundle import export_qwen
from dior_rt.export.qwen.graph import GraphWriter
from dior_rt.export.qwen.lora import Lora
from dior_rt.export.qwen.sources import Files, Sources
from dior_rt.families.qwen.model import Qwen
from dior_rt.flow.schedule import ShiftSchedule
from tools.qwen_memory import peak


@pytest.fixture
def folder(folders, tmp_path):
    """A copy of the diffusers folder, to be spoilt."""
    return Path(shutil.copytree(folders[True], tmp_path / "model"))


def refuse(folder, tmp_path, message, error=DiorError, **options):
    """Exporting fails with one sentence, and leaves nothing where the bundle would be."""
    out = tmp_path / "out" / "bundle"
    with pytest.raises(error, match=message) as caught:
        export_qwen(folder, out, RECIPE, **options)
    assert "\n" not in str(caught.value)
    assert not out.parent.exists() or not list(out.parent.iterdir())


@pytest.mark.parametrize("steps", [2, 4, 8, 40, 50])
@pytest.mark.parametrize("tokens", [9, 1024, 3953, 4096, 8192])
def test_the_schedule_is_the_schedulers(folders, steps, tokens):
    scheduler = FlowMatchEulerDiscreteScheduler(**tiny_qwen.SCHEDULER)
    mu = calculate_shift(tokens, 256, 8192, 0.5, 0.9)
    scheduler.set_timesteps(sigmas=np.linspace(1.0, 1 / steps, steps), mu=mu)
    schedule = Sources(folders[True]).schedule()
    np.testing.assert_allclose(schedule.sigmas(steps, tokens), scheduler.sigmas.numpy(), atol=1e-6)


def test_the_schedule_of_forty_steps_for_a_square(folders):
    sigmas = Sources(folders[True]).schedule().sigmas(40, 4096)
    np.testing.assert_allclose(sigmas[:4], [1, 0.986964, 0.973593, 0.959875], atol=1e-6)
    np.testing.assert_allclose(sigmas[-4:], [0.113533, 0.067881, 0.02, 0], atol=1e-6)


@pytest.mark.parametrize("steps", [4, 8])
def test_few_step_loras_run_on_their_own_schedule_without_guidance(folders, tmp_path, steps):
    # Lightning's own settings: base and max shift of ln 3, no terminal.
    settings = {
        **tiny_qwen.SCHEDULER,
        "base_shift": np.log(3),
        "max_shift": np.log(3),
        "shift_terminal": None,
    }
    scheduler = FlowMatchEulerDiscreteScheduler(**settings)
    scheduler.set_timesteps(sigmas=np.linspace(1.0, 1 / steps, steps), mu=np.log(3))
    recipe = replace(RECIPE, free_steps=False).few_steps(steps)
    bundle = export_qwen(folders[True], tmp_path / "bundle", recipe)
    qwen, photo = Qwen(bundle, "cpu"), np.full((96, 96, 3), 0.5, np.float32)
    condition = qwen.encode(photo, None, "estimate")
    assert (bundle.manifest.steps, bundle.manifest.guidance) == (steps, 1.0)
    np.testing.assert_allclose(qwen.sigmas(steps, condition), scheduler.sigmas.numpy(), atol=1e-6)
    # A folder whose scheduler says so itself is read the same way.
    found = replace_scheduler(folders[True], tmp_path / "model", settings)
    schedule = Sources(found).schedule()
    assert isinstance(schedule, ShiftSchedule) and schedule.shift == pytest.approx(3)


def replace_scheduler(folder, copy, settings):
    shutil.copytree(folder, copy)
    FlowMatchEulerDiscreteScheduler(**settings).save_pretrained(copy / "scheduler")
    return copy


def test_a_scheduler_of_another_kind_is_refused(folder, tmp_path):
    FlowMatchEulerDiscreteScheduler(shift=3.0, use_karras_sigmas=True).save_pretrained(folder / "scheduler")
    refuse(folder, tmp_path, "uses a schedule that this export does not support", InputError)


@pytest.mark.slow
def test_every_bundle_tells_what_its_precision_costs(make):
    parity = {
        p: read_bundle(make(precision=p, steps=6)).manifest.parity for p in ("fp32", "fp16", "int8", "int4")
    }
    assert parity["fp32"]["block"] < 1e-5 and parity["fp32"]["one_step"] == 0
    for part in ("vae_encoder", "vae_decoder", "text_block", "vision_block"):
        assert 0 < parity["fp32"][part] < 1e-5
    for part in ("text_block", "vision_block"):
        costs = [parity[p][part] for p in ("fp32", "fp16", "int8", "int4")]
        assert costs == sorted(costs) and costs[1] > 1e-5
    for figure in ("block", "one_step", "all_steps"):
        costs = [parity[p][figure] for p in ("fp32", "fp16", "int8", "int4")]
        assert costs == sorted(costs) and len(set(costs)) == 4
    assert parity["fp16"]["all_steps"] < 2e-3 < parity["int4"]["all_steps"] < 0.3
    pictures = [parity[p]["picture_db"] for p in ("fp16", "int8", "int4")]
    assert pictures == sorted(pictures, reverse=True) and pictures[-1] > 25


def test_lower_precisions_take_less_room(make):
    # Only the blocks count: the tiny autoencoder, float32 in all of them, outweighs everything else here.
    sizes = {}
    for precision in ("fp32", "fp16", "int8", "int4"):
        file = make(precision=precision, steps=6) / "transformer" / "block.00.data"
        assert file.with_suffix(".onnx").stat().st_size < 60_000
        sizes[precision] = file.stat().st_size
    assert sizes["fp32"] > sizes["fp16"] > sizes["int8"]


def test_no_modulation_weights_stay_where_the_steps_are_fixed(make):
    free, fixed = make(steps=6), make(steps=6, free_steps=False)
    assert (free / "modulation" / "block.00.data").is_file() and not (free / "modulation.npy").exists()
    assert not (fixed / "modulation").exists()
    table = np.load(fixed / "modulation.npy")
    assert table.shape == (6 + 1, 12 * 3 + 2, 48)


def test_one_file_of_weights_may_stand_in_for_the_folders(folders, pipes, tmp_path):
    tensors = {}
    for shard in (folders[True] / "transformer").glob("*.safetensors"):
        tensors |= load_file(shard)
    single = tmp_path / "single.safetensors"
    save_file({f"model.diffusion_model.{name}": tensor for name, tensor in tensors.items()}, single)
    folder = tmp_path / "model"
    shutil.copytree(folders[True], folder, ignore=shutil.ignore_patterns("diffusion_pytorch_model*0*"))
    qwen = Qwen(export_qwen(folder, tmp_path / "bundle", RECIPE, files=Files(single)), "cpu")
    got, want = call_both(qwen, pipes[True], 0.3, 5, [(4, 4), (4, 4)])
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def as_wan_names(name):
    """The name of an autoencoder's tensor where diffusers did not rename it."""
    layers = {"norm1": "residual.0", "conv1": "residual.2", "norm2": "residual.3", "conv2": "residual.6"}
    for part, index in layers.items():
        name = re.sub(rf"(blocks\.\d+|resnets\.\d+)\.{part}\.", rf"\1.{index}.", name)
    name = name.replace("conv_shortcut", "shortcut").replace("down_blocks", "downsamples")
    name = re.sub(r"mid_block\.resnets\.(\d)", lambda m: f"middle.{2 * int(m[1])}", name)
    name = name.replace("mid_block.attentions.0", "middle.1").replace("conv_in", "conv1")
    name = name.replace("norm_out", "head.0").replace("conv_out", "head.2")
    name = re.sub(r"up_blocks\.(\d)\.resnets\.(\d)", lambda m: f"upsamples.{4 * int(m[1]) + int(m[2])}", name)
    name = re.sub(r"up_blocks\.(\d)\.upsamplers\.0", lambda m: f"upsamples.{4 * int(m[1]) + 3}", name)
    return re.sub(r"^quant_conv", "conv1", re.sub(r"^post_quant_conv", "conv2", name))


def whole(folder):
    """The tensors of all shards."""
    return {
        name: tensor for shard in folder.glob("*.safetensors") for name, tensor in load_file(shard).items()
    }


def test_every_part_may_come_in_a_file_of_its_own(folders, make, tmp_path):
    # As they are handed on: the transformer under a prefix, the autoencoder in Wan's names, the text encoder
    # with the language model's head; and a folder of settings alone.
    renamed = {
        "transformer": "model.diffusion_model.{}".format,
        "vae": as_wan_names,
        "text_encoder": str,
    }
    files = {}
    for part, rename in renamed.items():
        tensors = {rename(name): tensor for name, tensor in whole(folders[True] / part).items()}
        files[part] = tmp_path / f"{part}.safetensors"
        save_file(tensors, files[part])
    settings = tmp_path / "model"
    shutil.copytree(folders[True], settings, ignore=shutil.ignore_patterns("*.safetensors*"))
    bundle = export_qwen(settings, tmp_path / "bundle", RECIPE, files=Files(**files))
    assert bundle.manifest.files == read_bundle(make()).manifest.files  # byte for byte


def test_a_part_that_is_nowhere_is_named(folder, tmp_path):
    for shard in (folder / "vae").glob("*.safetensors"):
        shard.unlink()
    refuse(folder, tmp_path, "vae should hold one safetensors file", InputError)
    refuse(folder, tmp_path, "There are no weights at .*none", InputError, files=Files(vae=tmp_path / "none"))


def test_weights_in_eight_bits_are_refused(folder, tmp_path):
    path = tmp_path / "fp8.safetensors"
    tensors = {n: t.to(torch.float8_e4m3fn) for n, t in whole(folder / "transformer").items()}
    save_file(tensors, path)
    refuse(folder, tmp_path, "needs float32, float16 or bfloat16", InputError, files=Files(path))


def test_weights_stored_as_bfloat16_are_read_as_what_they_are(folders, tmp_path):
    pipe = tiny_qwen.pipeline()
    pipe.transformer.to(torch.bfloat16)
    folder = tiny_qwen.save(pipe, tmp_path / "model")
    pipe.transformer.float()
    qwen = Qwen(export_qwen(folder, tmp_path / "bundle", RECIPE), "cpu")
    got, want = call_both(qwen, pipe, 0.3, 5, [(4, 4), (4, 4)])
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def test_a_missing_shard_is_named(folder, tmp_path):
    next((folder / "transformer").glob("*00003-of*")).unlink()
    refuse(folder, tmp_path, "lacks 1 of its 23 shards, such as diffusion_pytorch_model-00003", InputError)


@pytest.mark.parametrize("part", ["transformer", "vae", "text_encoder"])
def test_weights_cut_short_are_refused(folder, tmp_path, part):
    shard = sorted((folder / part).glob("*.safetensors"))[-1]
    shard.write_bytes(shard.read_bytes()[:-64])
    refuse(folder, tmp_path, "is cut short or is no safetensors file", InputError)


def test_weights_that_are_not_finite_are_refused(folder, tmp_path):
    shard = sorted((folder / "transformer").glob("*.safetensors"))[-1]
    tensors = load_file(shard)
    next(iter(tensors.values())).view(-1)[0] = torch.inf
    save_file(tensors, shard)
    refuse(folder, tmp_path, "contains values that are not finite", InputError)


def test_a_tensor_that_is_not_there_is_named(folder, tmp_path):
    config = json.loads((folder / "transformer" / "config.json").read_text())
    (folder / "transformer" / "config.json").write_text(json.dumps({**config, "num_layers": 4}))
    refuse(folder, tmp_path, "has no tensor 'transformer_blocks.3", InputError)


@pytest.mark.parametrize("name", ["guidance_embeds", "use_layer3d_rope"])
def test_other_models_of_the_class_are_refused(folder, tmp_path, name):
    config = json.loads((folder / "transformer" / "config.json").read_text())
    (folder / "transformer" / "config.json").write_text(json.dumps({**config, name: True}))
    refuse(folder, tmp_path, f"sets {name}", InputError)


def test_a_folder_that_is_no_model_is_refused(tmp_path):
    refuse(tmp_path / "nothing", tmp_path, "There is no model folder", InputError)
    (tmp_path / "empty").mkdir()
    refuse(tmp_path / "empty", tmp_path, "Cannot read .*transformer.*config.json", InputError)


def test_too_small_a_disk_is_told_before_anything_is_written(folders, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    refuse(folders[True], tmp_path, r"Too little room at .*: the export writes 0\.0 GB", BundleError)


def test_a_disk_that_fills_up_on_the_way_leaves_nothing(folders, tmp_path):
    # No file may grow beyond 200 KB: to the program that is a write that fails, as on a full disk.
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        refuse(folders[True], tmp_path, "Cannot write the bundle", BundleError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_bundle_that_is_there_stays_as_it_was_when_the_export_fails(folder, tmp_path):
    out = tmp_path / "out" / "bundle"
    export_qwen(folder, out, RECIPE)
    shard = sorted((folder / "transformer").glob("*.safetensors"))[-1]
    shard.write_bytes(shard.read_bytes()[:-64])
    with pytest.raises(InputError, match="cut short"):
        export_qwen(folder, out, RECIPE, overwrite=True)
    assert list(out.parent.iterdir()) == [out]
    read_bundle(out)


@pytest.mark.parametrize(
    "file", ["qwen.json", "prompts.npz", "transformer/block.01.data", "vae/decoder.onnx"]
)
def test_an_altered_bundle_is_refused(make, tmp_path, file):
    copy = tmp_path / "bundle"
    shutil.copytree(make(), copy)
    data = bytearray((copy / file).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / file).write_bytes(data)
    with pytest.raises(BundleError, match="does not match its sha256"):
        read_bundle(copy)
    (copy / file).unlink()
    with pytest.raises(BundleError, match="lacks its file"):
        read_bundle(copy)


def test_settings_that_make_no_sense_are_refused(make, tmp_path):
    bundle = read_bundle(make())
    shutil.copytree(bundle.folder, tmp_path / "bundle")
    spoilt = replace(bundle, folder=tmp_path / "bundle")
    settings = json.loads((spoilt.folder / "qwen.json").read_text())
    for change in ({"layers": 0}, {"multiple": 7}, {"axes": "all"}, {"unknown": 1}):
        (spoilt.folder / "qwen.json").write_text(json.dumps(settings | change))
        with pytest.raises(BundleError, match=r"Cannot read .*qwen\.json"):
            Qwen(spoilt, "cpu")


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_blocks():
    # 25 MB a block; were blocks kept, twelve would show 250 MB more than two.
    peaks = {blocks: peak(blocks) for blocks in (2, 6, 12)}
    assert peaks[2] < 200 and max(peaks.values()) - min(peaks.values()) < 20, peaks


@pytest.mark.slow
def test_weights_beyond_two_gigabytes_are_found(tmp_path):
    # 2^31 is where a protobuf ends and where signed offsets turn over.
    table = np.zeros((33, 1 << 24), np.float32)
    table[-1] = 3
    with GraphWriter(tmp_path / "large.onnx") as g:
        row = g.op("Gather", g.constant(table), g.input("index", dtype="int64"), axis=0)
        after = g.constant(np.arange(1000, dtype=np.float32))
        g.output("y", g.op("Add", after, g.op("ReduceMax", row, keepdims=0)), 1000)
        g.finish("large")
    assert g.data_path.stat().st_size > 1 << 31
    session = onnxruntime.InferenceSession(tmp_path / "large.onnx")
    (y,) = session.run(None, {"index": np.array(32)})
    np.testing.assert_array_equal(y, np.arange(1000) + 3)


def test_loras_are_part_of_the_bundle_and_not_beside_it(folders, tmp_path):
    path = tmp_path / "lora.safetensors"
    save_file({"img_in.lora_A.weight": torch.ones(2, 16), "img_in.lora_B.weight": torch.ones(48, 2)}, path)
    bundle = export_qwen(folders[True], tmp_path / "bundle", RECIPE, loras=[Lora(path)])
    assert not [file for file in bundle.manifest.files if "lora" in file]
    kinds = {Path(file).suffix for file in bundle.manifest.files}
    assert kinds == {".onnx", ".data", ".json", ".npz"}
