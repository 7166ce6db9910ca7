"""The whole way of a picture, with the weights that ship on a smaller grid."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.bundle import read_bundle, write_bundle
from dior_rt.errors import BundleError, Cancelled, DeviceError, InputError
from dior_rt.kernels import KernelError, NumpyOps, Strokes
from dior_rt.relight import Relighter

CHECKPOINT = Path(__file__).parents[2] / "training" / "checkpoints" / "mini"


@pytest.fixture(scope="module")
def relighter(mini_bundle):
    return Relighter(mini_bundle, device="cpu", ops="numpy")


def photo(height=60, width=90, seed=0):
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 256, (6, 9, 3), dtype=np.uint8))
    return np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC))


def drawing(height=60, width=90, light=(1.5, 0.8, 0.4)):
    strokes = Strokes(np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32))
    strokes.light[height // 3 : height // 2 + 1, : width // 2 + 1] = light
    strokes.mask[height // 3 : height // 2 + 1, : width // 2 + 1] = 1
    return strokes


def test_the_result_is_what_torch_and_a_plain_loop_give(relighter):
    """The same line in torch and NumPy, written out, from the checkpoint: 4 steps, guidance 2, seed 5."""
    torch = pytest.importorskip("torch")
    from dior_rt.export.lora import merge_lora
    from dior_rt.training.network import load_network

    network = merge_lora(load_network(CHECKPOINT / "model.safetensors"), CHECKPOINT / "lora")
    ops, picture, strokes = NumpyOps(), photo(), drawing()
    grid = relighter.bundle.manifest.grid.shape(60, 90)
    source = ops.reduce_photo(picture, grid)
    srgb = np.where(source <= 0.0031308, 12.92 * source, 1.055 * source ** (1 / 2.4) - 0.055)
    drawn = ops.reduce_strokes(strokes.light, strokes.mask, grid)

    def planes(pixels):
        return torch.tensor(pixels, dtype=torch.float32).permute(2, 0, 1)[None]

    seen, light, mask = planes(srgb), planes(drawn.light), planes(drawn.mask[..., None])
    noise = np.random.Generator(np.random.PCG64(5)).standard_normal((1, 3, *grid), dtype=np.float32)
    x, mode = torch.from_numpy(noise), torch.zeros(1, dtype=torch.int64)
    u = torch.linspace(1, 0, 5)
    sigmas = 1e4 * u / (1 + 9999 * u)
    with torch.inference_mode():
        for now, then in pairwise(sigmas):
            null = network(x, now[None], seen, 0 * light, 0 * mask, mode)
            cond = network(x, now[None], seen, light, mask, mode)
            x = x + (then - now) * (null + 2 * (cond - null))
    relit = (seen + x / 4).clamp(0, 1)[0].permute(1, 2, 0).numpy().astype(np.float64)
    linear = np.where(relit <= 0.04045, relit / 12.92, ((relit + 0.055) / 1.055) ** 2.4)
    expected = ops.transfer(picture, source, linear.astype(np.float32))

    got = relighter.relight(picture, strokes, seed=5).picture
    assert np.abs(got.astype(int) - expected).max() <= 1
    assert np.abs(got.astype(int) - picture).max() > 10


@pytest.mark.parametrize("size", [(60, 90), (61, 89), (1, 1), (1, 300), (257, 3), (40, 1000)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_result_has_the_photos_kind_dtype_and_size(relighter, size, dtype):
    picture = photo(*size)
    if dtype != np.uint8:
        picture = (picture / 255 * (65535 if dtype == np.uint16 else 1)).astype(dtype)
    before = picture.copy()
    relit = relighter.relight(picture, drawing(*size)).picture
    assert relit.dtype == dtype and relit.shape == (*size, 3)
    assert not np.array_equal(relit, picture)
    np.testing.assert_array_equal(picture, before)


def test_an_image_gives_an_image_of_the_same_pixels(relighter):
    picture = photo()
    relit = relighter.relight(Image.fromarray(picture), drawing()).picture
    assert isinstance(relit, Image.Image) and relit.mode == "RGB"
    np.testing.assert_array_equal(np.asarray(relit), relighter.relight(picture, drawing()).picture)


def test_a_seed_means_the_same_every_time_and_another_seed_another_picture(relighter):
    one, again, other = (relighter.relight(photo(), drawing(), seed=seed).picture for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_without_noise_all_seeds_agree(mini_bundle, tmp_path):
    bundle = read_bundle(mini_bundle)
    manifest = dataclasses.replace(bundle.manifest, noise_scale=0.0)
    write_bundle(tmp_path / "calm", manifest, {name: mini_bundle / name for name in bundle.manifest.files})
    calm = Relighter(tmp_path / "calm", device="cpu", ops="numpy")
    one, other = (calm.relight(photo(), drawing(), seed=seed).picture for seed in (0, 1))
    np.testing.assert_array_equal(one, other)


def test_intensity_multiplies_the_light(relighter):
    doubled = relighter.relight(photo(), drawing(), intensity=2.0).picture
    np.testing.assert_array_equal(doubled, relighter.relight(photo(), drawing(light=(3.0, 1.6, 0.8))).picture)
    assert not np.array_equal(doubled, relighter.relight(photo(), drawing()).picture)


def test_strokes_mean_the_same_in_every_form(relighter):
    light = np.full((60, 90, 3), 128, np.uint8)
    mask = np.zeros((60, 90), np.uint8)
    mask[20:40, 30:60] = 255
    rgba = np.dstack([light, mask])
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4
    floats = np.dstack([np.full((60, 90, 3), linear), mask / 255]).astype(np.float32)
    forms = [rgba, Image.fromarray(rgba), floats, Strokes(floats[..., :3], floats[..., 3])]
    results = [relighter.relight(photo(), form).picture for form in forms]
    for result in results[1:]:
        assert np.abs(result.astype(int) - results[0]).max() <= 1


def test_strokes_of_another_size_mean_the_same(relighter):
    full, half = (
        relighter.relight(photo(), drawing()).picture,
        relighter.relight(photo(), drawing(30, 45)).picture,
    )
    assert np.abs(full.astype(int) - half).mean() < np.abs(full.astype(int) - photo()).mean() / 4


def test_strokes_on_the_light_grid_are_taken_whatever_its_shape(relighter):
    picture = photo(40, 1000)
    rows, columns = relighter.bundle.manifest.grid.shape(40, 1000)
    assert relighter.relight(picture, drawing(rows, columns)).picture.shape == picture.shape
    with pytest.raises(InputError, match="shapes differ"):
        relighter.relight(picture, drawing(rows, columns // 2))


@pytest.mark.parametrize("kind", ["array", "image"])
def test_strokes_that_specify_nothing_change_nothing_and_run_nothing(relighter, kind):
    picture = photo() if kind == "array" else Image.fromarray(photo())
    nothing = Strokes(np.ones((60, 90, 3), np.float32), np.zeros((60, 90), np.float32))
    relit = relighter.relight(picture, nothing, progress=lambda *_: pytest.fail("the network ran"))
    np.testing.assert_array_equal(np.asarray(relit.picture), photo())
    assert relit.picture is not picture
    assert "specify nothing" in relit.notice and "steps" not in relit.seconds


def test_progress_counts_every_step_and_the_result_tells_what_was_used(relighter):
    seen = []
    relit = relighter.relight(
        photo(), drawing(), steps=3, guidance=1.0, seed=9, intensity=0.5, progress=lambda *at: seen.append(at)
    )
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert (relit.steps, relit.guidance, relit.seed, relit.intensity) == (3, 1.0, 9, 0.5)
    assert relit.notice is None
    assert set(relit.seconds) == {"kernels", "steps", "transfer"} and min(relit.seconds.values()) > 0
    defaults = relighter.relight(photo(), drawing())
    assert (defaults.steps, defaults.guidance) == (4, 2.0)


def test_progress_can_cancel(relighter):
    seen = []

    def stop_after_two(step, steps):
        seen.append(step)
        return step < 2

    with pytest.raises(Cancelled, match="step 2 of 4"):
        relighter.relight(photo(), drawing(), progress=stop_after_two)
    assert seen == [1, 2]


def test_many_threads_give_the_bytes_of_one(mini_bundle):
    relighter = Relighter(mini_bundle, device="cpu")
    sizes = [(60, 90), (61, 47), (33, 80), (60, 90)] * 3

    def relight(i):
        return relighter.relight(
            photo(*sizes[i], seed=i), drawing(*sizes[i]), seed=i, steps=2
        ).picture.tobytes()

    serial = [relight(i) for i in range(len(sizes))]
    with ThreadPoolExecutor(6) as pool:
        assert list(pool.map(relight, range(len(sizes)))) == serial


def test_every_way_to_compute_the_kernels_gives_the_same_picture(mini_bundle, relighter):
    other = Relighter(mini_bundle, device="cpu", ops="auto")
    one, two = (r.relight(photo(), drawing()).picture.astype(int) for r in (relighter, other))
    assert np.abs(one - two).max() <= 1
    assert other.ops_reason and other.device_reason


def test_an_estimate_is_a_light_map_of_the_grid(relighter):
    lumi, again = (relighter.estimate(photo(), seed=1) for _ in range(2))
    assert lumi.shape == (*relighter.bundle.manifest.grid.shape(60, 90), 3) and lumi.dtype == np.float32
    assert np.isfinite(lumi).all() and lumi.min() >= 0 and lumi.max() > 0
    np.testing.assert_array_equal(lumi, again)
    with pytest.raises(Cancelled):
        relighter.estimate(photo(), progress=lambda *_: False)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"steps": 0}, "steps"),
        ({"steps": 1001}, "steps"),
        ({"guidance": -1.0}, "guidance"),
        ({"guidance": float("nan")}, "guidance"),
        ({"intensity": -0.1}, "intensity"),
        ({"intensity": float("inf")}, "intensity"),
        ({"intensity": 3e38}, "too strong"),
        ({"seed": -1}, "seed"),
        ({"reach": 0.0}, "reach"),
        ({"reach": -1.0}, "reach"),
        ({"reach": float("nan")}, "reach"),
        ({"reach": float("inf")}, "reach"),
    ],
)
def test_settings_that_cannot_be_are_refused(relighter, settings, says):
    with pytest.raises(InputError, match=says):
        relighter.relight(photo(), drawing(), **settings)


def test_light_of_any_strength_gives_a_picture(relighter):
    for intensity in (0.0, 1e-6, 1e4):
        assert relighter.relight(photo(), drawing(), intensity=intensity).picture.shape == (60, 90, 3)


@pytest.mark.parametrize(
    ("option", "error"), [({"device": "gpu"}, DeviceError), ({"ops": "abacus"}, DeviceError)]
)
def test_what_is_not_there_is_refused(mini_bundle, option, error):
    with pytest.raises(error):
        Relighter(mini_bundle, **option)


def test_a_folder_that_is_no_bundle_is_refused(tmp_path):
    with pytest.raises(BundleError):
        Relighter(tmp_path)


@pytest.mark.parametrize("work", ["relight", "estimate"])
def test_a_driver_that_fails_on_the_way_is_a_device_error(mini_bundle, monkeypatch, work):
    """The error that OpenCLOps raises when a driver gives up in the middle of a run."""
    relighter = Relighter(mini_bundle, device="cpu", ops="numpy")

    def give_up(self, picture, grid):
        raise KernelError("The OpenCL device gave up: out of resources.")

    monkeypatch.setattr(NumpyOps, "reduce_photo", give_up)
    arguments = (photo(), drawing()) if work == "relight" else (photo(),)
    with pytest.raises(DeviceError, match=r"gave up: out of resources"):
        getattr(relighter, work)(*arguments)
