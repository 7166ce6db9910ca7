"""The transformer's graphs against diffusers' QwenImageTransformer2DModel."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_qwen
import torch
from agreement_qwen import call_both

from dior_rt.bundle import read_bundle
from dior_rt.engine import Engine
from dior_rt.export.qwen.errors import relative
from dior_rt.export.qwen.graph import GraphWriter, quantize_int4
from dior_rt.families.qwen.frame import Frame
from dior_rt.families.qwen.model import Condition, Qwen
from dior_rt.families.qwen.rope import joint_places, turns

# The largest error of one call, relative to the output's norm, on random weights.
BARS = {"fp32": 1e-5, "fp16": 2e-3, "int8": 5e-2, "int4": 2e-1}


@pytest.mark.parametrize("zero", [False, True])
@pytest.mark.parametrize("sigma", [1.0, 0.959875, 0.5, 0.02])
@pytest.mark.parametrize(
    ("words", "sizes"),
    [(1, [(2, 2), (2, 2)]), (7, [(4, 6), (4, 6), (4, 6)]), (13, [(5, 3), (2, 8), (7, 1)])],
    ids=["least", "two references", "odd sizes"],
)
def test_one_call_agrees_with_diffusers(qwens, pipes, zero, sigma, words, sizes):
    got, want = call_both(qwens[zero], pipes[zero], sigma, words, sizes)
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


def test_a_mask_of_ones_changes_nothing(qwens, pipes):
    got, want = call_both(qwens[True], pipes[True], 0.7, 9, [(4, 4), (4, 4)], mask=True)
    assert np.abs(got - want).max() <= 1e-4 * np.abs(want).max()


@pytest.mark.parametrize("precision", list(BARS))
def test_lower_precisions_stay_near(make, pipes, precision):
    qwen = Qwen(read_bundle(make(precision=precision, steps=6)), "cpu")
    got, want = call_both(qwen, pipes[True], 0.6, 7, [(4, 6), (4, 6)])
    assert relative(got, want) <= BARS[precision]


def test_several_texts_are_predicted_as_each_alone(qwens, pipes):
    qwen, random = qwens[True], np.random.default_rng(1)
    x, references = (random.standard_normal((n, 16), dtype=np.float32) for n in (16, 16))
    condition = Condition("relight", (32, 32), Frame.around((32, 32), 32), references, ((4, 4), (4, 4)), ())
    texts = [random.standard_normal((words, 32), dtype=np.float32) for words in (5, 8)]
    rows = qwen.modulation(np.array([0.5], np.float32))
    together = qwen.predict(x, condition, texts, rows)
    for text, got in zip(texts, together, strict=True):
        np.testing.assert_array_equal(got, qwen.predict(x, condition, [text], rows)[0])


def test_rotary_positions_are_diffusers_without_complex_numbers(pipes):
    sizes = ((5, 3), (2, 8))
    images, words = pipes[True].transformer.pos_embed([[(1, *size) for size in sizes]], max_txt_seq_len=6)
    cos, sin = turns(joint_places(6, sizes), (4, 6, 6), 10000.0)
    want = torch.cat([words, images]).numpy()
    np.testing.assert_allclose(cos + 1j * sin, want, atol=1e-6)


@pytest.mark.parametrize("precision", ["fp16", "int8"])
@pytest.mark.parametrize("magnitude", [1e-12, 1.0, 1e6, 1e30])
def test_a_linear_layer_neither_overflows_nor_vanishes(tmp_path, precision, magnitude):
    # fp16 ends at 65504 and loses what is below 6e-8: rows of either size must keep their relative accuracy.
    random = np.random.default_rng(0)
    x = random.standard_normal((5, 64), dtype=np.float32) * np.float32(magnitude)
    x[3] = 0
    weight = random.standard_normal((48, 64), dtype=np.float32) / 8
    bias = random.standard_normal(48, dtype=np.float32)
    with GraphWriter(tmp_path / "linear.onnx", precision) as g:
        g.output("y", g.linear(g.input("x", "rows", 64), weight, bias), "rows", 48)
        g.finish("linear")
    got = Engine(tmp_path / "linear.onnx").run({"x": x})["y"]
    want = x.astype(np.float64) @ weight.T + bias
    assert relative(got, want) <= {"fp16": 1e-3, "int8": 3e-2}[precision]
    np.testing.assert_array_equal(got[3], bias)


def test_int8_does_not_saturate_where_all_values_are_extreme(tmp_path):
    # Sums of two products in 16 bits, as x86 without VNNI makes them, would end at 32767.
    x = np.array([[1.0] * 256, [-1.0] * 256, [1.0, -1.0] * 128], np.float32)
    weight = np.array([[1.0] * 256, [-1.0] * 256, [1.0, -1.0] * 128], np.float32)
    with GraphWriter(tmp_path / "linear.onnx", "int8") as g:
        g.output("y", g.linear(g.input("x", "rows", 256), weight, None), "rows", 3)
        g.finish("linear")
    np.testing.assert_allclose(Engine(tmp_path / "linear.onnx").run({"x": x})["y"], x @ weight.T, rtol=1e-6)


def test_fp16_attention_survives_values_that_fp16_cannot_hold(tmp_path):
    random = np.random.default_rng(0)
    q, k, v = (random.standard_normal((6, 32), dtype=np.float32) for _ in range(3))
    with GraphWriter(tmp_path / "attention.onnx", "fp16") as g:
        inputs = [g.input(name, "tokens", 32) for name in "qkv"]
        g.output("y", g.attention(*inputs, heads=2), "tokens", 32)
        g.finish("attention")
    got = Engine(tmp_path / "attention.onnx").run({"q": q, "k": k, "v": v * np.float32(1e7)})["y"]
    heads = [torch.from_numpy(a.reshape(6, 2, 16).transpose(1, 0, 2)) for a in (q, k, v)]
    want = torch.nn.functional.scaled_dot_product_attention(*heads).permute(1, 0, 2).reshape(6, 32).numpy()
    assert relative(got / 1e7, want) <= 2e-3


def test_int4_keeps_each_blocks_extreme_and_rounds_the_rest(tmp_path):
    weight = np.random.default_rng(0).standard_normal((8, 96), dtype=np.float32)
    packed, scales = quantize_int4(weight)
    levels = np.stack([packed & 15, packed >> 4], axis=-1).reshape(8, 3, 32).astype(np.float32) - 8
    steps = scales.reshape(8, 3, 1)
    restored = levels * steps
    blocks = weight.reshape(8, 3, 32)
    extreme = np.abs(blocks).argmax(-1)[..., None]
    np.testing.assert_allclose(
        np.take_along_axis(restored, extreme, -1), np.take_along_axis(blocks, extreme, -1), rtol=1e-6
    )
    # The range is -8..7, so a value of the extreme's size and of the other sign loses a whole step.
    assert (np.abs(restored - blocks) <= np.abs(steps) * 1.001).all()
    with GraphWriter(tmp_path / "linear.onnx", "int4") as g:
        g.output("y", g.linear(g.input("x", "rows", 96), weight, None), "rows", 8)
        g.finish("linear")
    got = Engine(tmp_path / "linear.onnx").run({"x": np.eye(96, dtype=np.float32)})["y"]
    np.testing.assert_allclose(got, restored.reshape(8, 96).T, atol=1e-5)


def test_weights_of_zero_are_exact_in_int4():
    packed, scales = quantize_int4(np.zeros((2, 32), np.float32))
    assert (packed == 0x88).all() and (scales == 0).all()


def test_the_random_model_is_no_trivial_one(pipes):
    # If prompt, references or time had no effect, agreement would prove little.
    model = tiny_qwen.transformer()
    x, text = torch.randn(1, 32, 16), torch.randn(1, 5, 32)
    shapes = [[(1, 4, 4), (1, 4, 4)]]

    def call(x, text, t):
        with torch.no_grad():
            return model(x, text, None, torch.tensor([t]), shapes, return_dict=False)[0][:, :16]

    want = call(x, text, 0.5)
    changed = x.clone()
    changed[:, 16:] += 1
    for other in (call(changed, text, 0.5), call(x, text + 1, 0.5), call(x, text, 0.6)):
        assert (other - want).norm() > 0.02 * want.norm()
