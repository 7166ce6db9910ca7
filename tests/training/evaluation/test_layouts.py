"""Benchmarks in the layouts in which they are published, made here as small files; and a real scene."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.images.exr import write_exr
from dior_rt.kernels import NumpyOps
from dior_rt.training.evaluation.benchmarks import open_benchmarks

DATA = Path(os.environ.get("DIOR_TEST_DATA", "none"))


def picture(path: Path, grey: int, size: tuple[int, int] = (12, 8)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (grey, grey, grey)).save(path, quality=95)


def multi_illum(root: Path, scene: str, directions=range(25), mip: int = 6, **more) -> None:
    for direction in directions:
        picture(root / scene / f"dir_{direction}_mip{mip}.jpg", 10 * direction, **more)
    picture(root / scene / "thumb.jpg", 0)
    picture(root / scene / "materials_mip4.png", 0)
    picture(root / scene / "probes" / "dir_3_chrome32.jpg", 0)


def test_multi_illum_pairs_every_direction_with_the_opposite_one(tmp_path) -> None:
    multi_illum(tmp_path, "everett_kitchen2")
    multi_illum(tmp_path, "summer_house1")  # of the training set
    (found,) = open_benchmarks(tmp_path)
    assert (found.name, len(found), found.true_maps) == ("MultiIllum", 25, False)
    tasks = list(found)
    assert len({task.name for task in tasks}) == 25
    by_name = {task.name: task for task in tasks}
    task = by_name["everett_kitchen2-0-12"]
    assert np.abs(task.source.astype(int)).max() <= 2 and np.abs(task.truth.astype(int) - 120).max() <= 2
    assert task.source.shape == (8, 12, 3) and task.target_lumi is None
    (alone,) = open_benchmarks(tmp_path / "summer_house1")  # asked for by name
    assert len(alone) == 25


def test_multi_illum_takes_the_finest_level(tmp_path) -> None:
    multi_illum(tmp_path, "everett_a", mip=5, directions=range(4), size=(24, 16))
    multi_illum(tmp_path, "everett_a", mip=6, directions=range(4))
    assert {task.source.shape for task in open_benchmarks(tmp_path)[0]} == {(16, 24, 3)}


def test_multi_illum_in_linear_light_shares_one_exposure(tmp_path) -> None:
    for direction, light in ((0, 0.5), (1, 4.0)):
        folder = tmp_path / "everett_b"
        folder.mkdir(exist_ok=True)
        write_exr(folder / f"dir_{direction}_mip2.exr", np.full((8, 12, 3), light, np.float32))
    dim, bright = sorted((task.source for task in open_benchmarks(tmp_path)[0]), key=lambda p: p.mean())
    assert (bright == 255).all()
    assert NumpyOps().decode_srgb(dim).mean() == pytest.approx(1 / 8, rel=0.02)


def rene(root: Path, sets: int, cameras: int, black: set[tuple[int, int]] = frozenset()) -> None:
    for light in range(sets):
        folder = root / "cube" / f"lset{light:03d}"
        for camera in range(cameras):
            grey = 0 if (light, camera) in black else 40 + 20 * light + camera
            picture(folder / "data" / f"{camera:05d}_image.png", grey)
            (folder / "data" / f"{camera:05d}_pose.txt").write_text("1 0 0 0\n" * 4)
        (folder / "light.txt").write_text("0 0 1\n")
        (folder / "camera.yml").write_text("model: pinhole\n")


def test_rene_pairs_light_sets_through_one_camera(tmp_path) -> None:
    rene(tmp_path, sets=4, cameras=3)
    (found,) = open_benchmarks(tmp_path)
    assert (found.name, len(found), found.true_maps) == ("ReNe", 4, False)
    for task in found:
        scene, source, target, camera = task.name.split("-")
        assert scene == "cube" and abs(int(source[4:]) - int(target[4:])) == 2
        assert (task.source == 40 + 20 * int(source[4:]) + int(camera)).all()
        assert (task.truth == 40 + 20 * int(target[4:]) + int(camera)).all()


def test_rene_s_blacked_out_pictures_are_skipped(tmp_path) -> None:
    rene(tmp_path, sets=2, cameras=3, black={(0, 0), (1, 1)})
    assert [task.name[-5:] for task in open_benchmarks(tmp_path)[0]] == ["00002", "00002"]
    rene(tmp_path / "all", sets=2, cameras=2, black={(0, 0), (0, 1)})
    with pytest.raises(InputError, match="There are no renders in"):
        open_benchmarks(tmp_path / "all")


def test_views_of_different_sizes_are_refused(tmp_path) -> None:
    multi_illum(tmp_path, "everett_c", directions=(0,))
    picture(tmp_path / "everett_c" / "dir_1_mip6.jpg", 50, size=(9, 8))
    with pytest.raises(InputError, match="sizes differ"):
        list(open_benchmarks(tmp_path)[0])


def test_a_folder_of_nothing(tmp_path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match="There are no renders in"):
            open_benchmarks(folder)


@pytest.mark.skipif(not (DATA / "multi_illumination").is_dir(), reason="DIOR_TEST_DATA has no such scene")
def test_a_real_scene_of_multi_illum() -> None:
    (found,) = open_benchmarks(DATA / "multi_illumination")
    assert len(found) == 25
    task = next(iter(found))
    assert task.name.startswith("everett_kitchen2-") and task.source.shape == task.truth.shape
    assert 5 < np.abs(task.source.astype(float) - task.truth).mean() < 100
