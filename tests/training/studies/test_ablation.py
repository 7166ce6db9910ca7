"""The ablation: photos that stand in for real ones, the network as the runtime has it, and the rows."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.export.mini import MiniExportConfig, export_network
from dior_rt.kernels import NumpyOps, Strokes
from dior_rt.relight import Relighter
from dior_rt.training.data.maps import KINDS, LUMI, render_maps
from dior_rt.training.data.photos import take_photos
from dior_rt.training.data.render import View
from dior_rt.training.fit import Plan
from dior_rt.training.network import Config, Mini, load_network
from dior_rt.training.stage2 import load_scenes
from dior_rt.training.studies.ablation import (
    AHEAD,
    CONDITIONS,
    GRID,
    LAMPS,
    Budget,
    Condition,
    Network,
    ablate,
    judge,
)

OPS = NumpyOps()
TINY = Config(width=32, depth=1, heads=2, patch=4, fine=8, half=16, quarter=32)


@pytest.fixture(scope="module")
def maps(renders, tmp_path_factory):
    """Every map of the first two scenes' first views; not to be changed."""
    folder = tmp_path_factory.mktemp("maps")
    render_maps(renders, folder, 2, samples=2)
    return folder


def pixels(folder) -> dict[str, np.ndarray]:
    return {
        path.relative_to(folder).as_posix(): np.asarray(Image.open(path)) for path in folder.rglob("*.png")
    }


def test_photos_are_of_scenes_that_no_row_trains_on(renders, maps, tmp_path) -> None:
    folder = take_photos(renders, tmp_path / "photos", without=maps / LUMI, scenes=1)
    taken = pixels(folder)
    assert sorted(taken) == [f"007000002-1/{k}.png" for k in range(4)]
    assert all(photo.shape == (24, 24, 3) and photo.dtype == np.uint8 for photo in taken.values())
    first, *others = taken.values()
    assert all(not np.array_equal(first, other) for other in others)
    assert len(load_scenes(folder)) == 1
    again = pixels(take_photos(renders, tmp_path / "again", without=maps / LUMI, scenes=1))
    assert all(np.array_equal(taken[name], again[name]) for name in taken)
    with pytest.raises(InputError, match="not 2"):
        take_photos(renders, tmp_path / "more", without=maps / LUMI, scenes=2)
    with pytest.raises(InputError, match="There are no scenes in"):
        take_photos(tmp_path, tmp_path / "none")


def noisy_mini() -> Mini:
    """A network whose every weight says something."""
    torch.manual_seed(0)
    network = Mini(TINY)
    with torch.no_grad():
        for weight in network.parameters():
            weight += 0.02 * torch.randn_like(weight)
    return network.eval()


@pytest.mark.slow
def test_a_network_relights_as_the_runtime_does_in_one_step_without_noise(tmp_path) -> None:
    network, random = noisy_mini(), np.random.default_rng(0)
    recipe = MiniExportConfig(name="small", grid=GRID, steps=1, guidance=1.0, noise_scale=0.0)
    relighter = Relighter(
        export_network(network, recipe, tmp_path / "small", weights="fp32").folder, ops="numpy"
    )
    photo = random.integers(0, 256, (48, 64, 3), np.uint8)
    mask = np.zeros((48, 64), np.float32)
    mask[10:20, 30:50] = 1
    strokes = Strokes((random.uniform(0, 2, (48, 64, 3)) * mask[..., None]).astype(np.float32), mask)
    expected = np.asarray(relighter.relight(photo, strokes).picture).astype(int)
    got = Network(network).relight(photo, strokes)
    assert np.abs(got - expected).max() <= 1
    assert np.abs(got - photo.astype(int)).max() > 20


class Unmoved:
    """A network that leaves every photo as it is."""

    def relight(self, photo, strokes):
        return photo


class Brush:
    """A network that puts the drawn light in the photo's place."""

    def relight(self, photo, strokes):
        return np.where(strokes.mask[..., None] > 0, OPS.encode_srgb(strokes.light, np.uint8), photo)


def by_control(table, method: str) -> dict:
    return {row.control: row.figures for row in table.rows if row.method == method}


def test_figures_of_rows_whose_answers_are_known(maps) -> None:
    rows = {Condition("unmoved", LUMI): Unmoved(), Condition("brush", "phong"): Brush()}
    evaluation, examples = judge(rows, maps)
    answers, bounds, brush = evaluation.tables
    assert answers.pictures == 4 and brush.pictures == 2 and len(examples) == 6
    copy = by_control(bounds, "copy")[""]
    for control, figures in by_control(answers, "unmoved").items():
        assert {name: figures[name] for name in copy} == copy, control
        assert figures[AHEAD].mean == 0
    for control, figures in by_control(answers, "brush").items():
        assert control in ("dense", "strokes", LAMPS)
        assert figures[AHEAD].mean == pytest.approx(figures["PSNR"].mean - copy["PSNR"].mean)
    unmoved, drawn = (by_control(brush, name) for name in ("unmoved", "brush"))
    for followed in unmoved.values():
        assert all(figure.mean == pytest.approx(0, abs=1e-9) for figure in followed.values())
    for followed in drawn.values():
        assert (
            0.4 < followed["slope"].mean < 1.02 and followed["leakage"].mean == 0
        )  # display white bounds it
    assert unmoved["on its own map"] == unmoved["on the Lumi map"]
    assert drawn["on its own map"] != drawn["on the Lumi map"]


def test_rows_are_judged_by_the_same_pictures(maps, tmp_path) -> None:
    for kind in (LUMI, "phong"):
        (tmp_path / kind).mkdir()
        for path in (maps / kind).glob("*.npz"):
            view = View.load(path)
            images = view.images if kind == LUMI else view.images[..., ::-1]
            replace(view, images=images).save(tmp_path / kind / path.name)
    with pytest.raises(InputError, match="show different pictures"):
        judge({Condition("other", "phong"): Unmoved()}, tmp_path)
    with pytest.raises(InputError, match="train maps"):
        judge({Condition("none", "shading"): Unmoved()}, tmp_path)


@pytest.mark.slow
def test_every_row_is_trained_once_and_differs_by_what_it_is_named_after(renders, maps, tmp_path) -> None:
    short = Plan(steps=2, batch=2, warmup=1, average=1, rate=4e-3, grids=((16, 16),))
    budget = Budget(TINY, short, replace(short, seed=1), rank=2, scenes=1)
    steps = []
    evaluation, _ = ablate(maps, maps, renders, tmp_path, budget, lambda *step: steps.append(step[:2]))
    trained = [f"stage1-{kind}" for kind in KINDS] + [f"stage2-{kind}" for kind in KINDS] + ["lora-lumi"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*trained, "photos"])
    assert len(steps) == 2 * len(trained)
    assert {row.method for row in evaluation.tables[0].rows} == {row.name for row in CONDITIONS}

    stage1 = [load_network(tmp_path / name / "model.safetensors").head.weight for name in trained[:4]]
    assert all(not torch.equal(stage1[0], other) for other in stage1[1:])
    photo = np.random.default_rng(0).integers(0, 256, (24, 24, 3), np.uint8)
    strokes = Strokes(np.ones((24, 24, 3), np.float32), np.ones((24, 24), np.float32))
    with_photos, without = (Network.load(tmp_path / name) for name in ("stage2-lumi", "lora-lumi"))
    base, other = (network.network.base_model.model.state_dict() for network in (with_photos, without))
    same = {name for name in base if torch.equal(base[name], other[name])}
    assert {name for name in base if "lora" not in name} <= same  # one stage 1 for both
    assert same != set(base)
    assert with_photos.relight(photo, strokes).shape == photo.shape

    again, _ = ablate(maps, maps, renders, tmp_path, budget, lambda *step: steps.append(step[:2]))
    assert len(steps) == 2 * len(trained) and again == evaluation
