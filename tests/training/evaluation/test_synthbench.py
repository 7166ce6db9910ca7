"""SynthBench: rendered by the real renderer, small; human figures from made files in MakeHuman's layout."""

import gzip
import json
from dataclasses import asdict, replace
from importlib.metadata import PackageNotFoundError

import numpy as np
import pytest

from dior_rt.errors import InputError, MissingExtraError
from dior_rt.training.data.render import view
from dior_rt.training.evaluation import people, synthbench
from dior_rt.training.evaluation.benchmarks import open_benchmarks
from dior_rt.training.evaluation.metrics import psnr
from dior_rt.training.evaluation.synthbench import FIRST, MOST_COPY, Recipe, make, render_synthbench, staged
from dior_rt.training.scenes.scene import scene
from dior_rt.training.scenes.world import world

BOX = [(x, y, z) for y in (-8, 9) for x in (-2, 2) for z in (-1, 1)]
SIDES = ("1/1 2/2 4/4 3/3", "5/1 7/2 8/4 6/3", "1/1 3/2 7/4 5/3", "2/1 6/2 8/4 4/3", "1/1 5/2 6/4 2/3")


@pytest.fixture(autouse=True)
def makehuman(tmp_path, monkeypatch):
    """A figure that is a box of 17 decimetres, whose targets widen it or do nothing."""
    folder = tmp_path / "mpfb2"
    macro = folder / "targets" / "macrodetails"
    macro.mkdir(parents=True)
    (folder / "3dobjs").mkdir()
    lines = [
        "# CC0",
        *(f"v {x} {y} {z}" for x, y, z in BOX),
        *(f"vt {u} {v}" for u in (0, 1) for v in (0, 1)),
    ]
    for part in (*people.PARTS, "joint-pelvis"):
        lines += [f"g {part}", *(f"f {side}" for side in SIDES)]
    (folder / "3dobjs" / "base.obj").write_text("\n".join(lines))
    for sex in people.SEXES:
        for age in people.AGES:
            for descent in people.DESCENTS:
                with gzip.open(macro / f"{descent}-{sex}-{age}.target.gz", "wt") as file:
                    file.write("# widens\n0 -1 0 0\n7 .5 0 .25\n")
            for muscle in people.AMOUNTS:
                for weight in people.AMOUNTS:
                    name = f"universal-{sex}-{age}-{muscle}muscle-{weight}weight.target.gz"
                    with gzip.open(macro / name, "wt") as file:
                        file.write("3 0 0 0\n")
    monkeypatch.setattr(people, "_folder", lambda: folder)
    people.base.cache_clear()
    yield folder
    people.base.cache_clear()


def test_a_target_moves_the_vertices_it_names(makehuman) -> None:
    moves = people.target("asian-male-old", 8)
    assert moves[0].tolist() == [-1, 0, 0] and moves[7].tolist() == [0.5, 0, 0.25]
    assert not moves[1:7].any()
    with pytest.raises(InputError, match="no target of MakeHuman"):
        people.target("asian-male-old", 4)  # it names vertices that are not there


def test_quads_become_triangles_that_enclose_the_same(makehuman) -> None:
    figure = people.base()
    assert set(figure.parts) == set(people.PARTS)
    mesh = figure.mesh("body", figure.vertices)
    assert len(mesh.faces) == 2 * len(SIDES) and mesh.uv.min() == 0 and mesh.uv.max() == 1
    corners = mesh.vertices[mesh.faces].astype(float)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(2 * 4 * 2 + 2 * 4 * 17 + 2 * 17)


def test_a_person_stands_where_and_as_tall_as_asked(makehuman) -> None:
    at = np.array([0.3, 0.0, -0.2])
    for seed in range(5):
        things = people.person(np.random.default_rng(seed), 1.7, 0.4, at)
        assert 3 <= len(things) <= 4
        body = things[0].mesh.vertices
        assert body[:, 1].min() == pytest.approx(0, abs=1e-5) and np.ptp(body[:, 1]) == pytest.approx(1.7)
        assert np.abs(body[:, [0, 2]].mean(axis=0) - at[[0, 2]]).max() < 0.2
        assert (things[0].material.reflectance > 0).all() and (things[0].material.reflectance < 0.7).all()


def test_scenes_are_none_that_training_can_have() -> None:
    assert FIRST > 900 * 1_000_000 + 999_999  # render's last seed, and its last scene
    for number in range(8):
        described = staged(FIRST, number)
        without = (scene, world)[number // 2 % 2](FIRST, 1)
        assert described.kind == without.kind and described.sources[-1].kind == without.sources[-1].kind
        figure = len(described.things) - len(without.things)
        assert figure >= 3 if number % 2 else figure == 0


def test_pairs_differ_much_are_resumed_and_can_be_read(tmp_path) -> None:
    out, recipe = tmp_path / "bench", Recipe(2, seed=3, resolution=24, samples=2, speckle=255.0)
    render_synthbench(out, recipe, (0, 2))
    assert len(open_benchmarks(out)[0]) == 1
    before = (out / "0000" / "target.png").stat().st_mtime_ns
    render_synthbench(out, recipe)
    assert (out / "0000" / "target.png").stat().st_mtime_ns == before
    (found,) = open_benchmarks(out)
    assert (found.name, len(found), found.true_maps) == ("SynthBench", 2, True)
    for task in found:
        assert psnr(task.source, task.truth) <= MOST_COPY
        assert task.source.shape == (24, 24, 3) == task.target_lumi.shape == task.source_lumi.shape
        strokes = task.control("strokes")
        assert 0 < strokes.mask.mean() < 1 and np.array_equal(strokes.mask, task.mask)
        drawn = strokes.mask > 0
        assert np.array_equal(strokes.light[drawn], task.target_lumi[drawn])
        assert not strokes.light[~drawn].any()
        assert task.control("dense").mask.all()


@pytest.mark.parametrize("number", [0, 2])
def test_only_the_sources_that_shine_are_rendered_in_full(number, monkeypatch) -> None:
    """And the lights are those that the preview chose, though all other sources are dark now."""
    asked = []

    def spied(*args, **options):
        asked.append((args, options))
        return view(*args, **options)

    monkeypatch.setattr(synthbench, "view", spied)
    recipe = Recipe(1, seed=4, resolution=24, samples=2, speckle=255.0)
    task = make(number, recipe)
    (stage, described, camera, scene_number, *_), _ = asked[-2]
    (_, in_full, *_), options = asked[-1]
    assert options["denoised"] and 0 < len(in_full.sources) <= len(described.sources)
    preview = view(stage, described, camera, scene_number, 12, synthbench.PREVIEW)
    seed = synthbench.differing(preview)
    chosen = synthbench.used(preview, seed)
    assert [described.sources[k] for k in np.flatnonzero(chosen)] == list(in_full.sources)
    without = preview.images.copy()
    without[chosen] = 0
    sample, *_ = synthbench.shown(replace(preview, images=without), seed)
    assert not sample.photo.any() and not sample.relit.any()  # no other source reaches the pictures
    every = view(stage, described, camera, scene_number, 24, 2, denoised=True)
    full = view(stage, in_full, camera, scene_number, 24, 2, denoised=True)
    images, lumi = every.images.copy(), every.lumi.copy()
    images[chosen], lumi[chosen] = full.images, full.lumi  # the renderer's noise goes by a source's place
    _, source, truth = synthbench.shown(replace(every, images=images, lumi=lumi), seed)
    assert np.array_equal(source, task.source) and np.array_equal(truth, task.truth)


def test_noise_that_does_not_go_is_told(monkeypatch) -> None:
    monkeypatch.setattr(synthbench, "STRIDE", 1)
    with pytest.raises(InputError, match="take more samples than 1"):
        make(0, Recipe(1, resolution=16, samples=1, speckle=0.0))


def test_another_recipe_or_no_recipe_in_the_folder(tmp_path) -> None:
    (tmp_path / "synthbench.json").write_text(json.dumps(asdict(Recipe(1))))
    with pytest.raises(InputError, match="holds a SynthBench with other settings"):
        render_synthbench(tmp_path, Recipe(1, seed=5))
    (tmp_path / "synthbench.json").write_text("no")
    with pytest.raises(InputError, match="does not describe a SynthBench"):
        render_synthbench(tmp_path, Recipe(1))
    (tmp_path / "synthbench.json").write_text(json.dumps(asdict(Recipe(1))))
    with pytest.raises(InputError, match="has no pairs"):
        open_benchmarks(tmp_path)


def test_without_the_figures_no_folder_is_made(tmp_path, monkeypatch) -> None:
    monkeypatch.undo()

    def missing(name: str):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(people, "distribution", missing)
    people.base.cache_clear()
    with pytest.raises(MissingExtraError, match=r"dior-rt\[synthbench\]"):
        render_synthbench(tmp_path / "bench", Recipe(1))
    assert not (tmp_path / "bench").exists()


def test_a_target_without_lines_moves_nothing() -> None:
    """So is that of the average figure."""
    path = people._folder() / "targets" / "macrodetails" / "average.target.gz"
    path.write_bytes(gzip.compress(b"# CC0\n"))
    assert not people.target("average", 12).any()
