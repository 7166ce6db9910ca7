"""What is run, how errors and operations are counted, and what is kept of it."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from PIL import Image

from dior_rt.bench.difference import Difference, compare_pictures, worst
from dior_rt.bench.flops import node_flops, product_rate, step_feeds, step_flops, step_of
from dior_rt.bench.machine import Rooflines, measure_rooflines, medians, this_machine
from dior_rt.bench.plan import Setting, interleave, sweep, thread_counts
from dior_rt.bench.report import copy_share, pareto_front, read_report, write_report
from dior_rt.bench.run import measure
from dior_rt.bench.scene import write_scene
from dior_rt.bench.tables import as_markdown, compare
from dior_rt.bundle import Bundle, read_bundle
from dior_rt.cli import run
from dior_rt.engine import open_engine
from dior_rt.errors import DeviceError, InputError
from dior_rt.flow.solvers import SOLVERS
from dior_rt.images.photo import read_photo
from dior_rt.images.strokes import read_strokes
from dior_rt.presets import read_presets
from dior_rt.training.network import load_network

CHECKPOINT = Path(__file__).parents[3] / "training" / "checkpoints" / "mini" / "model.safetensors"
SETTING = Setting("mini", "reference", 40, "euler", 2.0, (), None, "cpu", "numpy", None)


def picture(seed: int, dtype: type = np.uint8) -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top, (300, 40, 3), dtype, endpoint=True)


# The plan


def test_a_setting_is_named_after_what_it_changes() -> None:
    assert SETTING.name(SETTING) == "reference"
    assert replace(SETTING, steps=8, guidance=1.0).name(SETTING) == "steps 8, guidance 1"
    assert replace(SETTING, interval=(0.3, 1.0)).name(SETTING) == "interval 0.3 to 1"
    assert replace(SETTING, preset="fast", steps=None, solver=None).name(SETTING) == "preset fast"


def test_a_preset_decides_what_its_setting_leaves_open() -> None:
    preset = replace(SETTING, preset="fast", steps=None, solver=None)
    assert preset.how() == {
        "preset": "fast",
        "steps": None,
        "solver": None,
        "guidance": 2.0,
        "tolerance": None,
        "interval": None,
    }
    assert replace(SETTING, interval=(0.3, 1.0)).how()["interval"] == (0.3, 1.0)


def test_the_sweep_changes_one_thing_at_a_time_and_nothing_twice(mini_bundle: Path) -> None:
    bundle = read_bundle(mini_bundle)
    settings = sweep([bundle], ["numpy", "opencl:0"], ["cpu", "openvino"], [1, 4, 8], [1])
    names = [setting.name(settings[0]) for setting in settings]
    assert names == [
        "reference",
        "steps 1",
        "steps 8",
        "guidance 1",
        *(f"preset {name}" for name in read_presets(bundle)),
        "threads 1",
        "ops opencl:0",
        "device openvino",
    ]
    assert (settings[0].steps, settings[0].guidance) == (4, 2.0)  # the bundle's own


def test_the_sweep_takes_every_way_to_walk_the_flow(mini_bundle: Path) -> None:
    bundle = read_bundle(mini_bundle)
    settings = sweep([bundle], ["numpy"], ["cpu"], [], ways=True)
    names = [setting.name(settings[0]) for setting in settings]
    presets = [f"preset {name}" for name in read_presets(bundle)]
    solvers = [f"solver {name}" for name in SOLVERS if name != "euler"]
    assert set(presets) | set(solvers) < set(names) and len(set(names)) == len(names)
    assert {"interval 0.5 to 1", "tolerance 0.00196"} < set(names)
    alone = Bundle(bundle.folder, replace(bundle.manifest, grid=None))
    assert not any(
        "tolerance" in s.name(settings[0]) for s in sweep([alone], ["numpy"], ["cpu"], [], ways=True)
    )


def test_the_reference_is_the_bundle_in_fp32(mini_bundle: Path) -> None:
    half = read_bundle(mini_bundle)
    half = Bundle(half.folder, replace(half.manifest, precision="fp16"))
    whole = Bundle(Path("whole"), replace(half.manifest, precision="fp32", steps=7, files={}))
    settings = sweep([half, whole], ["numpy"], ["cpu"], [])
    assert (settings[0].bundle, settings[0].steps) == ("whole", 7)
    assert {setting.bundle for setting in settings} == {"whole", str(half.folder)}
    assert sweep([half], ["numpy"], ["cpu"], [])[0].bundle == str(half.folder)


def test_repeats_take_turns() -> None:
    a, b, c = (replace(SETTING, steps=steps) for steps in (1, 2, 3))
    assert interleave([a, b, c], 2) == [a, b, c, a, b, c]


def test_threads_stay_below_what_all_of_them_are() -> None:
    assert [thread_counts(cores) for cores in (1, 2, 3, 8)] == [[], [1], [1, 2], [1, 2, 4]]


# Differences


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_picture_is_identical_to_itself(dtype: type) -> None:
    assert compare_pictures(picture(0, dtype), picture(0, dtype)) == Difference(None, 0.0, 0.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_psnr_is_that_of_scikit_image(dtype: type) -> None:
    metrics = pytest.importorskip("skimage.metrics")
    a, b = picture(1, dtype), picture(2, dtype)
    wanted = metrics.peak_signal_noise_ratio(a, b, data_range=np.iinfo(dtype).max)
    assert compare_pictures(b, a).psnr == pytest.approx(wanted, abs=1e-9)


def test_one_sample_that_differs() -> None:
    reference = np.full((300, 40, 3), 100, np.uint8)
    other = reference.copy()
    other[270, 3, 1] = 103
    difference = compare_pictures(other, reference)
    assert difference.largest == pytest.approx(3)
    assert difference.psnr == pytest.approx(10 * math.log10(reference.size * (255 / 3) ** 2))


def test_the_light_error_is_relative_and_linear() -> None:
    # sRGB 188 is linear 0.5029, sRGB 255 is 1: light that is off by 0.4971 of 1.
    white, grey = np.full((60, 60, 3), 255, np.uint8), np.full((60, 60, 3), 188, np.uint8)
    assert compare_pictures(grey, white).light == pytest.approx(0.4971, abs=1e-4)
    assert compare_pictures(white, grey).light == pytest.approx(0.4971 / 0.5029, abs=1e-3)


def test_a_black_reference_leaves_the_light_error_finite() -> None:
    black = np.zeros((8, 8, 3), np.uint8)
    assert compare_pictures(black, black).light == 0
    assert math.isfinite(compare_pictures(black + 255, black).light)


def test_what_the_eye_sees_is_asked_of_8_bits() -> None:
    seen = []

    def distance(one: np.ndarray, other: np.ndarray) -> float:
        seen.append((one.dtype, other.dtype))
        return float(np.abs(one.astype(int) - other).mean())

    light, dark = (np.full((8, 8, 3), 257 * level, np.uint16) for level in (200, 150))
    assert compare_pictures(dark, light, distance).lpips == 50
    assert seen == [(np.uint8, np.uint8)]
    assert worst([Difference(None, 0.0, 0.0, 0.1), Difference(30.0, 1.0, 0.0, 0.3)]).lpips == 0.3


def test_pictures_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="comparable"):
        compare_pictures(picture(0), picture(0)[:10])


def test_the_worst_photo_counts() -> None:
    differences = [Difference(None, 0.0, 0.0), Difference(30.0, 9.0, 0.1), Difference(40.0, 12.0, 0.05)]
    assert worst(differences) == Difference(30.0, 12.0, 0.1)
    assert worst(differences[:1]) == Difference(None, 0.0, 0.0)


def test_the_pareto_front_of_known_points() -> None:
    #         front       beaten      front       beaten by a tie  beaten      front
    points = [(3.0, 40.0), (4.0, 39.0), (1.0, 20.0), (1.0, 10.0), (3.5, 40.0), (9.0, 50.0)]
    assert pareto_front(points) == [2, 0, 5]
    assert pareto_front([]) == []


# Operations and rooflines


def test_operations_of_nodes() -> None:
    assert node_flops("MatMul", [(2, 64, 32), (32, 16)], (2, 64, 16)) == 2 * 2 * 64 * 16 * 32
    assert node_flops("Conv", [(1, 10, 8, 8), (6, 10, 3, 3), (6,)], (1, 6, 8, 8)) == 2 * 6 * 64 * 90
    assert node_flops("ConvTranspose", [(1, 10, 8, 8), (10, 6, 2, 2)], (1, 6, 16, 16)) == 2 * 6 * 256 * 10
    assert node_flops("Attention", [(2, 70, 32), (2, 50, 32)], (2, 70, 32)) == 2 * (2 * 70 * 50 * 32) * 2
    assert node_flops("Softmax", [(1, 64, 64)], (1, 64, 64)) == 0


@pytest.mark.parametrize(("guidance", "branches"), [(1.0, 1), (3.0, 2)])
def test_operations_of_a_network_counted_by_hand(mini_bundle: Path, guidance: float, branches: int) -> None:
    network = load_network(CHECKPOINT).config
    rows, columns = read_bundle(mini_bundle).manifest.grid.shape(100, 150)
    cells, width, patch = rows * columns, network.width, network.patch
    fine, half, quarter = network.fine, network.half, network.quarter
    tokens = cells // patch**2
    once = 2 * (width * width * 2 + width * 6 * width + width * fine)  # twice: time, modulation, state's gate
    block = tokens * width * (3 * width + width + 8 * width) + 2 * tokens * tokens * width
    ends = tokens * width * (3 * patch**2 + quarter * (patch // 4) ** 2)  # the state's tokens, unembed
    blends = cells // 16 * quarter * (9 * quarter + 4 * half) + cells // 4 * half * (9 * half + 4 * fine)
    convolutions = cells * 9 * fine * (3 + fine + 9)  # the state, smooth, head
    wanted = 2 * branches * (once + network.depth * block + ends + blends + convolutions)
    bundle = read_bundle(mini_bundle)
    step = step_of(bundle, (100, 150), guidance)
    assert step is not None and (step.rows * patch, step.columns * patch) == (rows, columns)
    assert step_flops(bundle, step) == wanted


def test_a_family_without_a_light_grid_is_not_counted(mini_bundle: Path) -> None:
    bundle = read_bundle(mini_bundle)
    assert step_of(Bundle(bundle.folder, replace(bundle.manifest, grid=None)), (8, 8), 1.0) is None


def test_the_products_of_a_step_are_a_part_of_its_time(mini_bundle: Path) -> None:
    bundle = read_bundle(mini_bundle)
    step = step_of(bundle, (300, 400), 1.0)
    assert step is not None
    engine, seconds = open_engine(bundle, "velocity", "cpu"), []
    for _ in range(9):
        start = time.perf_counter()
        engine.run(step_feeds(bundle, step))
        seconds.append(time.perf_counter() - start)
    share = step_flops(bundle, step) / product_rate(bundle, step) / median(seconds)
    assert 0.1 < share < 1.2  # other programs may slow one of the two


def test_rooflines_are_what_this_machine_can_do(mini_bundle: Path) -> None:
    # From a slow core that others use as well, to a large server.
    bundle = read_bundle(mini_bundle)
    step = step_of(bundle, (100, 150), 1.0)
    assert step is not None
    rooflines = measure_rooflines(["numpy"], {step: bundle})
    assert rooflines.products.keys() == {step.name} and 1e7 < rooflines.products[step.name] < 1e14
    assert 1e8 < rooflines.gemm < 1e14
    assert rooflines.copy.keys() == {"numpy"} and 1e7 < rooflines.copy["numpy"] < 1e13


def test_rooflines_are_medians() -> None:
    measured = [Rooflines(gemm, {"numpy": gemm / 2}, {"a": gemm * 3}) for gemm in (4.0, 100.0, 2.0)]
    assert medians(measured) == Rooflines(4.0, {"numpy": 2.0}, {"a": 12.0})


def test_the_share_of_the_copy_bandwidth() -> None:
    # 10 bytes read twice and written once in 2 s are 15 bytes a second.
    assert copy_share(10, 2.0, 60.0) == pytest.approx(0.25)


def test_the_machine_knows_itself() -> None:
    machine = this_machine()
    assert machine.cpu and 1 <= machine.usable_cores <= machine.cores
    assert machine.versions["numpy"] == np.__version__


# Processes


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not say")
def test_the_peak_of_memory_is_the_process_s_own() -> None:
    """Linux' getrusage gives a child its parent's peak; so the parent is made large, the child is not."""
    child = """
import sys
from dior_rt.bench.worker import peak_memory
held = bytearray(int(sys.argv[1]))
held[::4096] = b"1" * len(held[::4096])
print(peak_memory())
"""
    parent = f"""
import subprocess, sys
held = bytearray(b"1") * (400 << 20)
for size in ("1", "{150 << 20}"):
    subprocess.run([sys.executable, "-c", {child!r}, size], check=True)
"""
    result = subprocess.run([sys.executable, "-c", parent], capture_output=True, text=True, check=True)
    small, large = map(int, result.stdout.split())
    assert small < 100 << 20
    assert 150 << 20 <= large - small + (1 << 20) < 170 << 20


@pytest.mark.slow
def test_a_setting_that_fails_does_not_stop_the_others(mini_bundle: Path, tmp_path: Path) -> None:
    pairs = [write_scene(tmp_path, 0.005)]
    good = sweep([read_bundle(mini_bundle)], ["numpy"], ["cpu"], [1])[0]
    bad = replace(good, device="abacus")
    runs: list[str] = []
    outcome = measure([good, bad], pairs, 1, runs.append)
    assert list(outcome.measured) == [good] and "abacus" in outcome.failed[bad]
    with pytest.raises(DeviceError, match="abacus"):
        measure([good, bad], pairs, 1, runs.append, strict=True)
    with pytest.raises(DeviceError, match="abacus"):
        measure([bad, good], pairs, 1, runs.append)


def test_the_synthetic_pair_is_the_same_every_time(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    a, b = write_scene(tmp_path / "a", 0.1), write_scene(tmp_path / "b", 0.1)
    assert Path(a.photo).read_bytes() == Path(b.photo).read_bytes()
    photo = read_photo(Path(a.photo))
    assert math.prod(photo.size) == pytest.approx(1e5, rel=0.01)
    strokes = read_strokes(Path(a.strokes), photo.size)
    assert len(strokes) == 3 and photo.pixels.std() > 20


# The command


def test_a_quick_run_finds_less_error_with_more_steps(quick, mini_bundle: Path) -> None:
    assert quick.said.returncode == 0, quick.said.stderr
    assert quick.said.stderr == ""
    results = {result.name: result for result in quick.report.results}
    presets = [f"preset {name}" for name in read_presets(read_bundle(mini_bundle))]
    assert list(results) == ["reference", "steps 1", "steps 2", "guidance 1", *presets]
    reference, one, two = (results[name] for name in ("reference", "steps 1", "steps 2"))
    assert reference.difference == Difference(None, 0.0, 0.0) and reference.ratio == 1
    assert one.difference.psnr < two.difference.psnr
    assert one.difference.largest >= two.difference.largest > 0
    assert one.difference.light > two.difference.light > 0


def test_a_quick_run_books_every_stage(quick) -> None:
    for result in quick.report.results:
        stages = {name: seconds for name, seconds in result.seconds.items() if name != "total"}
        assert set(stages) == {"read", "kernels", "steps", "transfer", "write"}
        assert min(stages.values()) > 0
        assert result.seconds["total"] == pytest.approx(sum(stages.values()))  # there is one repeat
        assert result.images_a_minute == pytest.approx(60 / result.seconds["total"])
        assert result.setting.steps in (result.steps, None)
        assert result.per_step == pytest.approx(result.seconds["steps"] / result.steps)
        assert result.start_up > 0 and result.start_up_cold > 0
        assert 0 < result.copy_share < 5
        # Counted where every step runs all branches, once.
        assert (result.gemm_share is None) == (result.setting.solver != "euler")
        assert (result.gemm_share is None) == (result.product_share is None)
        assert result.product_share is None or 0 < result.product_share < 2
        assert result.gemm_share is None or 0 < result.gemm_share < 5


def test_a_report_survives_its_file(quick, tmp_path: Path) -> None:
    write_report(tmp_path / "again.json", quick.report)
    assert read_report(tmp_path / "again.json") == quick.report
    assert (tmp_path / "again.json").read_bytes() == (quick.folder / "bench.json").read_bytes()


def test_the_table_is_the_report(quick) -> None:
    assert quick.said.stdout.strip() == as_markdown(quick.report).strip()
    for result in quick.report.results:
        assert f"| {result.name} " in quick.said.stdout
    assert quick.report.bundles[0].sha256[:12] in quick.said.stdout


def test_the_plot_is_a_png(quick) -> None:
    with Image.open(quick.folder / "bench.png") as image:
        assert image.format == "PNG" and min(image.size) > 500


def test_the_plot_shows_which_settings_are_on_the_front(quick, tmp_path: Path) -> None:
    from dior_rt.bench.plot import plot

    def orange(seconds: list[float]) -> int:
        results = [
            replace(result, seconds=result.seconds | {"total": total})
            for result, total in zip(quick.report.results, seconds, strict=True)
        ]
        plot(tmp_path / "plot.png", replace(quick.report, results=tuple(results)))
        with Image.open(tmp_path / "plot.png") as image:
            pixels = np.asarray(image.convert("RGB")).astype(int)
        return int((np.abs(pixels - (255, 127, 14)).sum(axis=-1) < 30).sum())

    # Where the reference is fastest the front is its one point; else it is a line across the plot.
    rest = [8.0] * (len(quick.report.results) - 4)
    assert 0 < 4 * orange([1.0, 2.0, 3.0, 4.0, *rest]) < orange([4.0, 1.0, 2.0, 8.0, *rest])


def test_compared_with_itself_all_ratios_are_one(quick) -> None:
    text = compare(quick.report, quick.report)
    assert text.count("| 1.000") == 4 * len(quick.report.results) and "not the same" not in text


def test_compare_says_how_much_and_what_else_changed(quick) -> None:
    old = quick.report
    first = old.results[0]
    faster = replace(first, seconds=first.seconds | {"total": first.seconds["total"] / 2})
    new = replace(old, results=(faster,), photos=(replace(old.photos[0], sha256="0" * 64),))
    text = compare(new, old)
    assert "| reference | 0.500" in text and "steps 1" not in text
    assert "differs: photos" in text


@pytest.mark.slow
def test_compare_from_the_command_line(quick, bench, mini_bundle: Path) -> None:
    options = ["--bundle", mini_bundle, "--ops", "numpy", "--device", "cpu", "--megapixels", 0.02, "--quick"]
    said = bench(*options, "--steps", 1, "--compare", quick.folder / "bench.json")
    assert said.returncode == 0, said.stderr
    assert "| new / old " in said.stdout and "not the same" not in said.stdout


@pytest.mark.slow
def test_what_cannot_be_done_is_one_sentence(mini_bundle: Path, tmp_path: Path, capfd) -> None:
    (tmp_path / "broken.json").write_text('{"format": 1}')
    photo = tmp_path / "photo.png"
    Image.new("RGB", (30, 20)).save(photo)
    cases = {
        "there is no such file": ["--compare", tmp_path / "missing.json"],
        "lacks the key": ["--compare", tmp_path / "broken.json"],
        "stands alone": [photo],
        "no such file": [photo, tmp_path / "missing.png", "--quick"],
        "abacus": ["--device", "abacus", "--quick"],
        "no pixel kernels called": ["--ops", "abacus"],
        "a plot is a .png file": ["--plot", tmp_path / "plot.pdf"],
        "does not exist": ["--json", tmp_path / "missing" / "bench.json"],
    }
    for words, options in cases.items():
        assert run(["bench", "--bundle", str(mini_bundle), *map(str, options)]) == 2, words
        said = capfd.readouterr()
        assert words in said.err and said.err.count("\n") == 1 and said.out == ""


def test_without_matplotlib_the_plot_names_the_extra(mini_bundle: Path, monkeypatch, capfd) -> None:
    monkeypatch.delitem(sys.modules, "dior_rt.bench.plot", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    assert run(["bench", "--bundle", str(mini_bundle), "--plot", "plot.png"]) == 2
    assert "pip install 'dior-rt[bench]'" in capfd.readouterr().err


def test_a_report_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(InputError, match=r"Cannot read the benchmark .*list\.json"):
        read_report(tmp_path / "list.json")
