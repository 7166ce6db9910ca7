"""The evaluation: baselines with known answers, methods beside them, the report; a bundle from end to end."""

import json

import numpy as np
import pytest
from PIL import Image

from dior_rt.cli import run as cli
from dior_rt.errors import BundleError, InputError
from dior_rt.kernels import NumpyOps
from dior_rt.relight import Relighter
from dior_rt.training.evaluation.baselines import gain, match, quotient
from dior_rt.training.evaluation.benchmarks import open_benchmarks
from dior_rt.training.evaluation.methods import Model, Pictures, Settings, open_method
from dior_rt.training.evaluation.report import CELL, GAP, as_json, contact_sheet, markdown, write_report
from dior_rt.training.evaluation.results import Evaluation, Example, Figure
from dior_rt.training.evaluation.run import Plan, evaluate, run

OPS = NumpyOps()
PHOTO = np.random.default_rng(0).integers(20, 90, (24, 32, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def answers(renders, tmp_path_factory):
    """Another method's pictures for both benchmarks of the renders: it knows the truth of "replace"."""
    folder = tmp_path_factory.mktemp("another")
    for benchmark in open_benchmarks(renders):
        for task in benchmark:
            picture = task.truth if benchmark.name == "replace" else task.source
            Image.fromarray(picture).save(folder / f"{task.name}.png")
    return folder


def test_gain_undoes_a_gain() -> None:
    brighter = OPS.encode_srgb(OPS.decode_srgb(PHOTO) * np.array([2, 3, 0.5], np.float32), np.uint8)
    assert np.abs(gain(PHOTO, brighter).astype(int) - brighter).max() <= 1
    assert np.array_equal(gain(PHOTO, PHOTO), PHOTO)
    assert not gain(np.zeros_like(PHOTO), PHOTO).any()  # black has no gain


def test_match_undoes_a_linear_change_of_codes() -> None:
    changed = np.rint(PHOTO * np.array([2, 1.5, 1]) + np.array([10, 0, 40])).astype(np.uint8)
    assert np.abs(match(PHOTO, changed).astype(int) - changed).max() <= 1
    flat = np.full_like(PHOTO, 77)
    assert (match(PHOTO, flat) == 77).all() and (match(flat, flat) == 77).all()


def test_the_quotient_of_matte_white_light_is_exact() -> None:
    """A matte picture is albedo * Lumi map, so the quotient of true maps leads to the truth."""
    rng = np.random.default_rng(1)
    albedo = rng.uniform(0.2, 0.8, (24, 32, 3)).astype(np.float32)
    source, target = rng.uniform(0.3, 1, (2, 24, 32, 3)).astype(np.float32)
    photo, truth = (OPS.encode_srgb(albedo * light, np.uint8) for light in (source, target))
    relit = quotient(photo, source, target)
    # The 0.02 that the quotient adds to both maps costs a few codes of 255.
    assert np.abs(relit.astype(float) - truth).mean() < 3 < 10 < np.abs(photo.astype(float) - truth).mean()
    assert np.array_equal(quotient(photo, source, source), photo)


def test_the_quotient_of_maps_smaller_than_the_photo() -> None:
    ones = np.ones((6, 8, 3), np.float32)
    twice = OPS.decode_srgb(quotient(PHOTO, ones, ones * np.float32(2.02)))
    assert np.median(twice / OPS.decode_srgb(PHOTO)) == pytest.approx(2, rel=0.03)


def test_another_method_stands_beside_the_baselines(renders, answers) -> None:
    method = open_method(answers, Settings())
    assert isinstance(method, Pictures)
    replaced, changed = (run(method, found)[0] for found in open_benchmarks(renders))
    rows = {row.method: row for row in replaced.rows}
    assert list(rows) == ["copy", "gain", "mean and deviation", "quotient", answers.name]
    assert rows["quotient"].control == "true maps"  # nothing estimates here
    best = rows[answers.name].figures
    assert best["RMSE"] == Figure(0, 0, 0) and best["PSNR"].mean == pytest.approx(100)
    assert best["SSIM"].mean == pytest.approx(1)
    assert rows["copy"].figures["PSNR"].mean < rows["quotient"].figures["PSNR"].mean
    assert rows["copy"].figures["RMSE"].low < rows["copy"].figures["RMSE"].mean
    rows = {row.method: row for row in changed.rows}
    assert rows[answers.name].figures == rows["copy"].figures


def test_gain_is_never_worse_than_copy_in_linear_mean(renders) -> None:
    for task in open_benchmarks(renders)[0]:
        wanted = OPS.decode_srgb(task.truth).mean((0, 1))
        got = OPS.decode_srgb(gain(task.source, task.truth)).mean((0, 1))
        had = OPS.decode_srgb(task.source).mean((0, 1))
        assert (np.abs(got - wanted) <= np.abs(had - wanted) + 0.01).all()


def test_pictures_that_are_missing_or_of_another_size(renders, answers, tmp_path) -> None:
    task = next(iter(open_benchmarks(renders)[0]))
    with pytest.raises(InputError, match=f"{task.name}.png: there is no such file"):
        Pictures(tmp_path).picture(task)
    Image.new("RGB", (5, 4)).save(tmp_path / f"{task.name}.png")
    with pytest.raises(InputError, match="has 5 x 4 pixels and should have 24 x 24"):
        Pictures(tmp_path).picture(task)


def test_a_folder_that_is_no_method(tmp_path) -> None:
    with pytest.raises(BundleError):
        open_method(tmp_path, Settings())


def test_a_bundle_is_measured_with_its_own_settings_or_those_asked_for(mini_bundle, renders) -> None:
    own = open_method(mini_bundle, Settings())
    asked = open_method(mini_bundle, Settings(steps=1, noise_scale=0.0, reach=0.1))
    manifest = Relighter(mini_bundle, ops="numpy").bundle.manifest
    assert own.settings == Settings(manifest.steps, manifest.guidance, manifest.noise_scale, None)
    assert asked.settings == Settings(1, manifest.guidance, 0.0, 0.1)
    task = next(iter(open_benchmarks(renders)[0]))
    strokes = task.control("strokes")
    relit = own.relight(task.source, strokes)
    assert np.array_equal(relit, own.relight(task.source, strokes))
    same = asked.relighter.relight(task.source, strokes, steps=1, reach=0.1).picture
    assert np.array_equal(same, asked.relight(task.source, strokes)) and not np.array_equal(relit, same)


def test_a_bundle_from_end_to_end(mini_bundle, renders, tmp_path) -> None:
    Image.fromarray(np.tile(PHOTO, (2, 2, 1))).save(tmp_path / "photo.png")
    plan = Plan(views=2, dabs=1, photos=tmp_path)
    evaluation, examples = evaluate(mini_bundle, renders, Settings(steps=1, reach=0.5), plan)
    assert len(examples) == 4 and all(example.strokes for example in examples)
    assert [table.benchmark for table in evaluation.tables] == ["replace", "change"]
    for table in evaluation.tables:
        assert table.pictures == 2 and table.estimate and np.isfinite(table.estimate.mean)
        controls = [row.control for row in table.rows]
        assert controls[3:] == ["true maps", "estimated maps", "dense", *["strokes"] * 3]
        assert [row.method for row in table.rows[-3:]] == ["glow", "blur", "small"]
        assert table.rows[-1].seconds > 0
    assert evaluation.control.response.dabs == 1 and evaluation.borders.photos == 1
    text = markdown(evaluation)
    assert text.startswith("**small**: 1 steps, guidance 2, noise 1, reach 0.5\n")
    assert text.count("| strokes |") == 6 and "cut from the true Lumi map" in text
    assert json.loads(as_json(evaluation))["control"]["response"]["dabs"] == 1
    write_report(tmp_path / "report", evaluation, examples)
    assert (tmp_path / "report" / "report.md").read_text() == text + "\n"
    assert json.loads((tmp_path / "report" / "report.json").read_text())
    with Image.open(tmp_path / "report" / "contact.png") as sheet:
        assert sheet.width == 4 * (CELL + GAP) + GAP


def test_real_pairs_are_driven_by_light_estimated_from_the_target(mini_bundle, tmp_path) -> None:
    for direction in range(2):
        grey = np.roll(np.tile(PHOTO, (2, 2, 1)), 9 * direction, axis=1)
        (tmp_path / "everett_d").mkdir(exist_ok=True)
        Image.fromarray(grey).save(tmp_path / "everett_d" / f"dir_{direction}_mip6.jpg")
    model = open_method(mini_bundle, Settings())
    assert isinstance(model, Model)
    (found,) = open_benchmarks(tmp_path)
    table, examples = run(model, found.first(1))
    assert "estimated from the target by the same model" in table.control and table.estimate is None
    assert [row.control for row in table.rows][3:] == ["estimated maps", "dense", *["strokes"] * 3]
    task = next(iter(found))
    lumi, strokes = model.estimate(task.truth), examples[0].strokes
    drawn = strokes.mask > 0
    assert np.array_equal(strokes.light[drawn], lumi[drawn])  # of the target, not of the source
    assert "estimated from the target" in markdown(Evaluation(model.name, model.settings, (table,)))


def test_the_contact_sheet_shows_what_it_says(renders) -> None:
    benchmark = open_benchmarks(renders)[0]
    method = Pictures(renders)
    (task,) = benchmark.first(1)
    strokes = task.control("strokes")
    sheet = np.asarray(contact_sheet([Example(task, strokes, 255 - task.source)]))
    assert method.name == renders.name and sheet.shape[0] == 14 + CELL + 14 + GAP
    cells = [sheet[28:220:8, GAP + k * (CELL + GAP) :][:, :CELL:8] for k in range(4)]  # 24 pixels, 8 times
    assert np.array_equal(cells[0], task.source) and np.array_equal(cells[3], task.truth)
    assert np.array_equal(cells[2], 255 - task.source)
    assert (cells[1][strokes.mask == 0] == 128).all()
    shown = OPS.encode_srgb(strokes.light, np.uint8)
    assert np.array_equal(cells[1][strokes.mask > 0], shown[strokes.mask > 0])


def test_what_cannot_be_done_is_told_before_any_work(mini_bundle, renders, tmp_path, capfd) -> None:
    (tmp_path / "file").touch()
    for option, where, saying in (
        ("--photos", tmp_path, "There are no pictures in"),
        ("--out", tmp_path / "file", "Cannot make the folder"),
    ):
        assert cli(["train", "eval", str(mini_bundle), str(renders), option, str(where)]) == 2
        said = capfd.readouterr()
        assert said.err.count("\n") == 1 and saying in said.err and not said.out
