"""Read published benchmarks of real pairs: one view, two lights, no true maps.

MultiIllum   {scene}/dir_{0..24}_mip{m}.jpg or .exr, with probes and materials (Murmann et al. 2019);
             everett* are its test scenes
ReNe         {scene}/lset{000..039}/{light.txt,camera.yml,data/{00000..00049}_{image.png,pose.txt}}
             (Toschi et al. 2023): light sets, each seen by the same cameras
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from dior_rt.errors import InputError
from dior_rt.images.exr import read_exr
from dior_rt.images.photo import read_photo
from dior_rt.training.evaluation.metrics import Photo
from dior_rt.training.evaluation.tasks import OPS, Benchmark, Task

DIRECTION = re.compile(r"dir_(\d+)_mip(\d+)\.(jpg|exr)")
WHITE = 98  # the percentile of a scene's linear pictures that becomes display white


def multi_illum(folder: Path) -> list[Benchmark]:
    """Return pairs of flash directions half the list apart, at the finest available level.

    The scenes are everett*, the test set. The folder may also be a single scene.
    """
    load = []
    for scene in (folder, *sorted(folder.glob("everett*"))):
        photos = _directions(scene)
        for number, target in enumerate(photos):
            source = photos[number - len(photos) // 2]
            if source != target:
                name = "-".join([scene.name, *(path.name.split("_")[1] for path in (source, target))])
                load.append(partial(photographed, name, source, target, number))
    return [Benchmark("MultiIllum", tuple(load), False)] if load else []


def _directions(scene: Path) -> list[Path]:
    """Return the pictures of the finest level by direction, JPEG before EXR."""
    found = [match for path in scene.iterdir() if (match := DIRECTION.fullmatch(path.name))]
    order = [(int(match[2]), match[3] == "exr", int(match[1]), match[0]) for match in found]
    return [scene / name for *level, _, name in sorted(order) if level == list(min(order)[:2])]


def rene(folder: Path) -> list[Benchmark]:
    """Return pairs of light sets half the list apart, each from a different camera.

    Black pictures, such as those of the published test set, are skipped.
    """
    load = []
    for scene in (folder, *sorted(path for path in folder.iterdir() if path.is_dir())):
        sets = sorted(path for path in scene.glob("lset*") if (path / "data").is_dir())
        for number, target in enumerate(sets):
            source = sets[number - len(sets) // 2]
            if source != target and (camera := _shared_camera(source / "data", target / "data", 7 * number)):
                name = f"{scene.name}-{source.name}-{target.name}-{camera[:5]}"
                load.append(
                    partial(photographed, name, source / "data" / camera, target / "data" / camera, number)
                )
    return [Benchmark("ReNe", tuple(load), False)] if load else []


def _shared_camera(source: Path, target: Path, turn: int) -> str | None:
    """Return the first picture from the turn-th camera on that both light sets have and that is not black."""
    names = sorted(path.name for path in target.glob("*_image.png") if (source / path.name).is_file())
    start = turn % max(len(names), 1)
    return next((n for n in names[start:] + names[:start] if _lit(source / n) and _lit(target / n)), None)


def _lit(path: Path) -> bool:
    return bool(read_picture(path).any())


def photographed(name: str, source: Path, target: Path, seed: int) -> Task:
    """Read a pair of photos. Linear ones share an exposure under which neither is overexposed."""
    if source.suffix == ".exr":
        linear = [read_exr(path, "photo")[..., :3] for path in (source, target)]
        white = max(float(np.percentile(light.max(axis=2), WHITE)) for light in linear)
        before, after = (OPS.encode_srgb(light / np.float32(max(white, 1e-6)), np.uint8) for light in linear)
    else:
        before, after = read_picture(source), read_picture(target)
    if before.shape != after.shape:
        raise InputError(f"{source} and {target} should show one view, but their sizes differ.")
    return Task(name, before, after, seed=seed)


def read_picture(path: Path) -> Photo:
    """Return the 8-bit sRGB pixels (H, W, 3) of a picture. Raises InputError."""
    pixels = read_photo(path).pixels
    return pixels if pixels.dtype == np.uint8 else OPS.encode_srgb(OPS.decode_srgb(pixels), np.uint8)
