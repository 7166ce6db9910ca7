"""RealBench: pairs from view files, their recipe, and the refusals; the sheet of lighting ideas."""

import json

import numpy as np
import pytest

from dior_rt.cli import run as cli
from dior_rt.errors import InputError
from dior_rt.training.evaluation.benchmarks import open_benchmarks
from dior_rt.training.evaluation.judges.realbench import (
    KINDS,
    MOST_COPY,
    Lit,
    Recipe,
    change_lamp,
    make_realbench,
    read_view,
    source_lights,
)
from dior_rt.training.evaluation.judges.sheet import CELL, GAP, IDEAS, contact, read_ideas
from dior_rt.training.evaluation.judges.subjects import find_photo
from dior_rt.training.evaluation.metrics import psnr

SIDE = 32


def store(path, split="test", lamps=4, world=True) -> None:
    """Write a view as a view store does: lamps on a grey wall, whose Lumi maps have one value a pixel."""
    rows, columns = np.indices((SIDE, SIDE)) / SIDE
    centres = np.random.default_rng(0).uniform(0.2, 0.8, (lamps, 2))
    lumi = np.stack([np.exp(-8 * ((rows - y) ** 2 + (columns - x) ** 2)) for y, x in centres])
    images = np.repeat(0.5 * lumi[..., None], 3, axis=-1)
    arrays = {}
    if world:
        arrays["world_lumi"] = np.full((SIDE, SIDE, 3), 0.25, np.float16)
        images = np.concatenate([images, np.full((1, SIDE, SIDE, 3), 0.125)])
    head = np.array(json.dumps({"format": 1, "split": split}))
    np.savez(path, images=images.astype(np.float16), lumi=lumi.astype(np.float16), head=head, **arrays)


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    folder = tmp_path_factory.mktemp("views")
    for k in range(3):
        store(folder / f"{k}.npz")
    return folder


def test_the_pairs_are_whole_and_made_once(views, tmp_path) -> None:
    recipe = Recipe(pairs=6, seed=1)
    make_realbench(views, tmp_path, recipe)
    (found,) = open_benchmarks(tmp_path)
    tasks = list(found)
    assert found.name == "RealBench" and found.true_maps and len(tasks) == 6
    assert {task.name.split("-")[1] for task in tasks} == set(KINDS)
    for task in tasks:
        assert psnr(task.source, task.truth) <= MOST_COPY
        strokes = task.control("strokes")
        assert strokes is task.strokes and 0 < strokes.mask.mean() < 0.7
        assert task.control("dense").mask.all()
        # A white matte wall of half the light: 2 * photo is the Lumi map, where nothing clips.
        photo = np.asarray(task.source, np.float32) / 255
        linear = np.where(photo <= 0.04045, photo / 12.92, ((photo + 0.055) / 1.055) ** 2.4)
        assert np.median(np.abs(2 * linear - task.source_lumi)[photo.max(axis=2) < 0.99]) < 0.01
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    make_realbench(views, tmp_path, recipe)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    make_realbench(views, tmp_path, Recipe(pairs=7, seed=1))
    assert len(open_benchmarks(tmp_path)[0]) == 7
    with pytest.raises(InputError, match="another recipe"):
        make_realbench(views, tmp_path, Recipe(pairs=6, seed=2))


def test_one_lamp_changes_and_the_world_stays() -> None:
    view, rng = Lit(np.ones((5, 4, 4, 3)), np.ones((5, 4, 4, 3)), True), np.random.default_rng(0)
    for kind, on, off in (("change", 0, 0), ("add", 1, 0), ("replace", 1, 1)):
        for _ in range(20):
            lights = source_lights(rng, view)
            changed = change_lamp(rng, view, lights, kind)
            before, after = lights.any(axis=1), changed.any(axis=1)
            assert (after & ~before).sum() == on and (before & ~after).sum() == off
            assert np.array_equal(lights[-1], changed[-1])
            assert (lights != changed).any(axis=1).sum() == max(on + off, 1)
    assert source_lights(rng, Lit(np.ones((2, 4, 4, 3)), np.ones((2, 4, 4, 3)), True)) is None


def test_what_is_no_view_or_belongs_to_training_is_refused(views, tmp_path) -> None:
    assert read_view(views / "0.npz").world and read_view(views / "0.npz").lumi.shape == (5, SIDE, SIDE, 3)
    store(tmp_path / "train.npz", split="train")
    with pytest.raises(InputError, match="training split"):
        read_view(tmp_path / "train.npz")
    (tmp_path / "broken.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="is no view that can be used"):
        read_view(tmp_path / "broken.npz")
    with pytest.raises(InputError, match="There are no views"):
        make_realbench(tmp_path / "none", tmp_path / "out", Recipe())
    assert not (tmp_path / "out").exists()
    (tmp_path / "one").mkdir()
    store(tmp_path / "one" / "dark.npz", lamps=1)
    with pytest.raises(InputError, match=r"1 views give 0 pairs, not 300\. Render more views"):
        make_realbench(tmp_path / "one", tmp_path / "out", Recipe())


def test_realbench_by_the_command(views, tmp_path, capfd) -> None:
    assert cli(["train", "realbench", str(views), "--out", str(tmp_path / "bench"), "--pairs", "3"]) == 0
    assert len(list((tmp_path / "bench").glob("*/target.png"))) == 3
    assert cli(["train", "realbench", str(tmp_path), "--out", str(tmp_path / "other")]) == 2
    assert capfd.readouterr().err.splitlines()[-1].startswith("dior-rt: ")


def test_the_ideas_are_ten_photos_with_three_each() -> None:
    ideas = read_ideas()
    names = [idea.photo for idea in ideas]
    assert len(ideas) == 30 and all(names.count(name) == 3 for name in names) and len(set(names)) == 10
    assert {idea.strokes for idea in ideas} == {path.name for path in IDEAS.glob("*-*.json")}
    assert all(find_photo(name).is_file() for name in names)


def test_a_sheet_lays_out_rows_of_pictures(tmp_path) -> None:
    picture = np.full((100, 200, 3), 7, np.uint8)
    sheet = contact([[("photo", picture), ("idea", picture)], [("photo", picture)]])
    assert sheet.width == 2 * (CELL + GAP) and sheet.getpixel((50, 50)) == (7, 7, 7)
    with pytest.raises(InputError, match="Cannot read the ideas"):
        read_ideas(tmp_path)


def test_the_sheet_by_the_command(mini_bundle, tmp_path, monkeypatch) -> None:
    from dior_rt.training.evaluation.judges import sheet

    two = [idea for idea in read_ideas() if "coffee" in idea.photo][:2]
    monkeypatch.setattr(sheet, "read_ideas", lambda folder=IDEAS: two)
    assert cli(["train", "sheet", str(mini_bundle), "--out", str(tmp_path / "sheet"), "--steps", "1"]) == 0
    written = sorted(path.name for path in (tmp_path / "sheet").iterdir())
    assert written == ["coffee-candle.png", "coffee-window.png", "sheet.jpg"]
