"""How the flow is walked: presets, what goes over them, steps by tolerance; by the Relighter and the CLI."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.bench.promise import write_presets
from dior_rt.bundle import Bundle, read_bundle
from dior_rt.cli import run
from dior_rt.errors import BundleError, InputError
from dior_rt.flow.sampler import sample
from dior_rt.flow.schedule import DynamicShiftSchedule
from dior_rt.kernels import Stroke
from dior_rt.presets import PRESETS, Preset, read_presets
from dior_rt.relight import Relighter
from dior_rt.sampling import Sampling, SamplingFields, SamplingOptions, resolve_sampling

FAST = Preset(2, "adams", 5.0, (0.9, 1.0))


@pytest.fixture(scope="module")
def bundle(mini_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The model that ships on a smaller grid (4 steps, guidance 2), with two presets."""
    folder = tmp_path_factory.mktemp("presets") / "small"
    shutil.copytree(mini_bundle, folder)
    return write_presets(read_bundle(folder), {"fast": FAST, "balanced": Preset(3)})


@pytest.fixture(scope="module")
def relighter(bundle: Bundle) -> Relighter:
    return Relighter(bundle.folder, device="cpu", ops="numpy")


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    coarse = Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8))
    return np.asarray(coarse.resize((90, 60), Image.Resampling.BICUBIC))


STROKES = [Stroke(((20, 20), (60, 40)), 12, (1.0, 0.8, 0.5), 1.5)]


def resolve(bundle: Bundle, preset: str | None = None, **fields) -> Sampling:
    return resolve_sampling(bundle, SamplingOptions(preset=preset, **fields))


def test_the_reference_is_the_models_own(bundle: Bundle) -> None:
    assert resolve(bundle) == Sampling(4, "euler", None, (0.0, 1.0), "reference", 2.0, None, 1.0)
    assert resolve(bundle, "reference") == resolve_sampling(bundle)


def test_what_is_asked_goes_over_the_preset(bundle: Bundle) -> None:
    assert resolve(bundle, "fast") == Sampling(2, "adams", 5.0, (0.9, 1.0), "fast", 2.0)
    asked = resolve(bundle, "fast", steps=7, solver=None, guidance=3.0, interval=(0.1, 0.2), noise_scale=0.5)
    assert asked == Sampling(7, "adams", 5.0, (0.1, 0.2), "fast", 3.0, None, 0.5)


def test_keywords_go_over_the_options_and_are_the_same_fields() -> None:
    options = SamplingOptions(steps=3, guidance=2.0)
    assert options.override(steps=5, guidance=None) == SamplingOptions(steps=5, guidance=2.0)
    assert SamplingFields.__annotations__.keys() == SamplingOptions.__dataclass_fields__.keys()
    with pytest.raises(TypeError, match="sigma"):
        options.override(sigma=1)


@pytest.mark.parametrize(
    ("preset", "asked", "says"),
    [
        ("turbo", {}, "no preset 'turbo', only: reference, "),
        (None, {"steps": 0}, "steps must lie between 1 and 1000"),
        (None, {"solver": "magic"}, "solver must be one of euler, "),
        (None, {"shift": 0.0}, "shift must be"),
        (None, {"interval": (0.5, 0.2)}, "interval must be two numbers"),
        (None, {"interval": (-0.1, 0.2)}, "interval must be two numbers"),
        (None, {"interval": (float("nan"), 0.2)}, "interval must be two numbers"),
        (None, {"guidance": float("inf")}, "guidance must lie"),
        (None, {"noise_scale": -1.0}, "noise_scale must lie"),
        (None, {"tolerance": 0.0}, "tolerance must lie between 0 and 1"),
        (None, {"tolerance": float("nan")}, "tolerance must lie between 0 and 1"),
        (None, {"tolerance": 0.01, "steps": 4}, "A tolerance chooses the steps"),
        ("fast", {"tolerance": 0.01, "solver": "heun"}, "A tolerance chooses the steps"),
    ],
)
def test_what_cannot_be_is_one_sentence(bundle: Bundle, preset, asked, says: str) -> None:
    with pytest.raises(InputError, match=says):
        resolve(bundle, preset, **asked)


def test_a_model_with_another_schedule_or_no_grid_says_what_it_cannot(bundle: Bundle) -> None:
    schedule = DynamicShiftSchedule(0.5, 0.9, 256, 8192, 0.02)
    other = Bundle(bundle.folder, replace(bundle.manifest, schedule=schedule, grid=None))
    with pytest.raises(InputError, match="shift is not for the caller"):
        resolve(other, shift=3.0)
    with pytest.raises(InputError, match="takes steps, not a tolerance"):
        resolve(other, tolerance=0.01)


def test_a_bundle_without_presets_has_the_reference_alone(mini_bundle: Path, tmp_path: Path) -> None:
    shipped = read_bundle(mini_bundle)
    files = {name: digest for name, digest in shipped.manifest.files.items() if name != PRESETS}
    bare = Bundle(shipped.folder, replace(shipped.manifest, files=files))
    assert read_presets(bare) == {}
    with pytest.raises(InputError, match=r"only: reference\."):
        resolve(bare, "fast")


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        '{"fast": {}}',
        '{"fast": {"steps": 0, "solver": "euler", "shift": null, "interval": [0, 1]}}',
        "{",
    ],
)
def test_presets_that_are_none_are_refused(bundle: Bundle, tmp_path: Path, text: str) -> None:
    (tmp_path / PRESETS).write_text(text)
    with pytest.raises(BundleError, match=r"Cannot read .*presets\.json"):
        read_presets(Bundle(tmp_path, bundle.manifest))


def test_a_preset_runs_its_solver_over_its_schedule_and_guides_in_its_interval(relighter, photo) -> None:
    """The same line of the picture, put together from the parts by hand."""
    family, grid = relighter._family, relighter._family.raster(60, 90)
    drawn = relighter._reduce_strokes(STROKES, (60, 90), grid, 1.0)
    source, encoded = family.reduce_photo(photo, grid, relighter._ops)
    condition = family.encode(encoded, drawn, "relight")
    sigmas = np.array([1, 5 / 6, 0], np.float32)  # shift 5
    guided, plain = (family.velocity(condition, sigmas, scale) for scale in (2.0, 1.0))
    noise = np.random.Generator(np.random.PCG64(3)).standard_normal((1, 3, *grid), dtype=np.float32)
    *_, state = sample(lambda x, sigma: (guided if sigma > 0.9 else plain)(x, sigma), noise, sigmas, "adams")
    relit = relighter._ops.decode_srgb(family.decode_relit(state.x, condition))
    expected = relighter._ops.transfer(photo, source, relit)
    got = relighter.relight(photo, STROKES, preset="fast", seed=3)
    np.testing.assert_array_equal(got.picture, expected)
    assert got.steps == 2 and relighter.presets == ("reference", "fast", "balanced")


def test_the_noise_is_as_strong_as_asked(relighter, photo) -> None:
    without = [relighter.relight(photo, STROKES, noise_scale=0.0, seed=seed) for seed in (1, 2)]
    np.testing.assert_array_equal(without[0].picture, without[1].picture)
    options = SamplingOptions(noise_scale=1.0)
    noisy = [relighter.relight(photo, STROKES, options, seed=seed).picture for seed in (1, 2)]
    assert (noisy[0] != noisy[1]).any()
    assert without[0].sampling.facts()["noise_scale"] == 0.0
    silent = [relighter.estimate(photo, noise_scale=0.0, seed=seed) for seed in (1, 2)]
    np.testing.assert_array_equal(*silent)


def test_the_bundle_of_a_relighter_cannot_be_replaced(relighter, bundle) -> None:
    with pytest.raises(AttributeError):
        relighter.bundle = bundle


def test_a_tolerance_tells_the_steps_it_took_and_progress_jumps_to_the_end(relighter, photo) -> None:
    seen = []
    relit = relighter.relight(
        photo, STROKES, tolerance=20 / 255, progress=lambda step, steps: seen.append((step, steps))
    )
    assert relit.steps == len(seen) and relit.sampling.tolerance == 20 / 255
    assert [step for step, _ in seen] == sorted({step for step, _ in seen}) and seen[-1] == (4, 4)


def relight(folder: Path, photo: np.ndarray, *options: str) -> int:
    Image.fromarray(photo).save(folder / "photo.png")
    rgba = np.zeros((60, 90, 4), np.uint8)
    rgba[20:40, 10:60] = (255, 220, 160, 255)
    Image.fromarray(rgba).save(folder / "strokes.png")
    files = [str(folder / name) for name in ("photo.png", "strokes.png")]
    return run(["relight", *files, "--device", "cpu", "--ops", "numpy", *options])


def test_the_command_reports_the_preset_and_what_went_over_it(bundle, photo, tmp_path, capfd) -> None:
    how = ["--preset", "fast", "--interval", "0.2", "0.7", "--bundle", str(bundle.folder), "--json"]
    assert relight(tmp_path, photo, *how) == 0
    settings = json.loads(capfd.readouterr().out)["settings"]
    said = {name: settings[name] for name in ("preset", "steps", "solver", "shift", "interval", "guidance")}
    assert said == {
        "preset": "fast",
        "steps": 2,
        "solver": "adams",
        "shift": 5.0,
        "interval": [0.2, 0.7],
        "guidance": 2.0,
    }
    with Image.open(tmp_path / "photo-relit.png") as picture:
        assert any('"preset": "fast"' in str(value) for value in picture.info.values())


def test_the_command_takes_a_tolerance_as_a_fraction(bundle, photo, tmp_path, capfd) -> None:
    how = ["--tolerance", "20/255", "--bundle", str(bundle.folder), "--json"]
    assert relight(tmp_path, photo, *how) == 0
    settings = json.loads(capfd.readouterr().out)["settings"]
    assert settings["tolerance"] == pytest.approx(20 / 255) and settings["steps"] > 1
    assert "solver" not in settings


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--preset", "turbo"], "no preset 'turbo'"),
        (["--solver", "magic"], "solver must be one of"),
        (["--tolerance", "1/0"], "no number and no fraction"),
        (["--tolerance", "small"], "no number and no fraction"),
        (["--tolerance", "0.1", "--steps", "3"], "A tolerance chooses the steps"),
        (["--interval", "0.9", "0.1"], "interval must be two numbers"),
    ],
)
def test_the_command_refuses_in_one_sentence(bundle, photo, tmp_path, capfd, options, says) -> None:
    assert relight(tmp_path, photo, *options, "--bundle", str(bundle.folder)) == 2
    said = capfd.readouterr()
    assert says in said.err and "Traceback" not in said.err
    assert not (tmp_path / "photo-relit.png").exists()
