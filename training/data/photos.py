"""Photos of rendered scenes, one view under several lights. They replace real pairs in stage 2.

{out}/{view}/{k}.png     8-bit sRGB, by one random camera a view
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.files import make_folder, replacing
from dior_rt.training.data.camera import eight_bits, random_camera, white_balance
from dior_rt.training.data.render import View
from dior_rt.training.data.triplets import exposed, mix, random_lights, usable_sources

PHOTOS: Final = 4  # of a view


def take_photos(
    renders: Path,
    out: Path,
    without: Path | None = None,
    scenes: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Take photos of scenes from their second cameras, to `out/<view>/<k>.png`, and return `out`.

    without: a folder of views whose scenes are left out. scenes: the number of scenes, None for all. Raises
    InputError where there are too few others.
    """
    taken = {path.stem.partition("-")[0] for path in without.glob("*-*.npz")} if without else set()
    paths = [path for path in sorted(renders.glob("*-1.npz")) if path.stem.partition("-")[0] not in taken]
    besides = f" besides those of {without}" if without else ""
    if not paths:
        raise InputError(f"There are no scenes in {renders}{besides}.")
    if scenes and len(paths) < scenes:
        raise InputError(f"There are {len(paths)} scenes in {renders}{besides}, not {scenes}.")
    paths = paths[:scenes]
    for number, path in enumerate(paths):
        view = View.load(path)
        make_folder(folder := out / path.stem)
        for k, photo in enumerate(photos_of(view, np.random.default_rng([seed, number]))):
            with replacing(folder / f"{k}.png") as file:
                Image.fromarray(photo).save(file, "PNG")
        if progress:
            progress(number + 1, len(paths))
    return out


def photos_of(view: View, rng: Generator, count: int = PHOTOS) -> Iterator[NDArray[np.uint8]]:
    """Yield a view under random lights, each time taken by one camera of random style: (H, W, 3) 8-bit
    sRGB.
    """
    camera, balance = random_camera(rng), white_balance(rng)
    usable = usable_sources(view)
    for _ in range(count):
        image, _ = mix(view, random_lights(rng, usable))
        linear = image * exposed(image, rng.uniform(0.3, 1.1)) * balance
        yield eight_bits(camera.shot(linear, rng))
