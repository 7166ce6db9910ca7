"""Pack renders into small shards: one zip of pictures for many views, about 25 KB per view.

A view is two AVIF sheets, a lossless PNG of object numbers, and a JSON head. The colour sheet holds the
picture under every source, the environment's Lumi map, normals and albedo. The grey sheet holds the lamps'
Lumi maps and depth.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from dior_rt.errors import InputError
from dior_rt.training.blender.store import load_view
from dior_rt.training.light import linear_to_srgb
from dior_rt.training.lumen.views import Views, to_code

LARGEST = 55_000_000  # bytes per shard
COLUMNS = 4  # tiles per row of a sheet
COLOUR_QUALITY = 78
GREY_QUALITY = 82
SKY = 255
SOURCES = 8
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Rendered:
    """One view as a renderer writes it, linear float32."""

    name: str
    images: NDArray[np.float32]  # (K, H, W, 3)
    lumi: NDArray[np.float32]  # (K, H, W, 3); 0 in the sky
    world: NDArray[np.bool_]  # (K,) the source is the environment
    normal: NDArray[np.float32]  # (H, W, 3)
    albedo: NDArray[np.float32]  # (H, W, 3)
    depth: NDArray[np.float32]  # (H, W) distance along the view axis
    ids: NDArray[np.int32]  # (H, W)
    sky: NDArray[np.bool_]  # (H, W)
    slope: float  # tangent of half the angle of view


def rendered(path: Path) -> Rendered:
    """Return a view that `dior_rt.training.blender` stored. Raises InputError."""
    view = load_view(path)
    sky = view.sky.astype(np.float32) > 0.5
    lumi = view.lumi_maps().astype(np.float32)
    lumi[:, sky] = 0
    return Rendered(
        name=path.stem,
        images=view.images.astype(np.float32)[:SOURCES],
        lumi=lumi[:SOURCES],
        world=np.array([light["kind"] == "world" for light in view.head.lights])[:SOURCES],
        normal=view.normals.astype(np.float32),
        albedo=view.albedo.astype(np.float32),
        depth=np.where(sky, 1e3, view.depth.astype(np.float32)),
        ids=view.ids.astype(np.int32),
        sky=sky,
        slope=math.tan(math.radians(view.head.camera["fov"]) / 2),
    )


def sheet(tiles: NDArray[np.uint8]) -> Bytes:
    """Return (N, H, W, C) tiles, row by row, as one picture."""
    rows = -(-len(tiles) // COLUMNS)
    blank = np.zeros((rows * COLUMNS, *tiles.shape[1:]), np.uint8)
    blank[: len(tiles)] = tiles
    h, w, c = tiles.shape[1:]
    return blank.reshape(rows, COLUMNS, h, w, c).transpose(0, 2, 1, 3, 4).reshape(rows * h, COLUMNS * w, c)


def tiles_of(picture: Bytes, side: int) -> Bytes:
    """Invert `sheet`."""
    rows, columns, c = picture.shape[0] // side, picture.shape[1] // side, picture.shape[2]
    return picture.reshape(rows, side, columns, side, c).transpose(0, 2, 1, 3, 4).reshape(-1, side, side, c)


def encode_view(view: Rendered) -> dict[str, bytes]:
    """Return the files of a view, by name."""
    image_most = np.array([max(float(np.quantile(i, 0.9998)), 1e-6) for i in view.images], np.float32)
    lumi_most = np.array([max(float(np.quantile(i, 0.9998)), 1e-6) for i in view.lumi], np.float32)

    def codes(light: NDArray[np.float32], most: NDArray[np.float32]) -> Bytes:
        return to_code(torch.from_numpy(light), torch.from_numpy(most)[:, None, None, None]).numpy()

    images, lumi = codes(view.images, image_most), codes(view.lumi, lumi_most)
    depth = np.log(np.maximum(view.depth, 1e-3))
    seen = depth[~view.sky] if (~view.sky).any() else np.zeros(1, np.float32)
    near, far = float(seen.min()), float(np.quantile(seen, 0.999)) + 1e-3
    depth_code = np.clip(np.rint(255 * (depth - near) / (far - near)), 0, 255).astype(np.uint8)
    normal = np.rint(127.5 * (view.normal + 1)).clip(0, 255).astype(np.uint8)
    srgb = linear_to_srgb(torch.from_numpy(view.albedo).clamp(0, 1)).numpy()
    albedo = np.rint(255 * srgb).astype(np.uint8)
    colour = np.concatenate([images, lumi[view.world], normal[None], albedo[None]])
    grey = np.concatenate([lumi[~view.world][..., 1:2], depth_code[None, ..., None]])
    ids = np.where(view.sky, SKY, view.ids.clip(0, SKY - 1)).astype(np.uint8)
    head = {
        "sources": len(view.images),
        "world": view.world.tolist(),
        "image_most": image_most.tolist(),
        "lumi_most": lumi_most.tolist(),
        "depth_range": [near, far],
        "slope": view.slope,
        "side": int(view.images.shape[1]),
    }
    return {
        f"{view.name}/colour.avif": _picture(
            sheet(colour), "AVIF", quality=COLOUR_QUALITY, subsampling="4:4:4", speed=6
        ),
        f"{view.name}/grey.avif": _picture(
            sheet(grey)[..., 0], "AVIF", quality=GREY_QUALITY, subsampling="4:0:0", speed=6
        ),
        f"{view.name}/ids.png": _picture(ids, "PNG", optimize=True),
        f"{view.name}/head.json": json.dumps(head).encode(),
    }


def _picture(pixels: Bytes, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options)
    return file.getvalue()


def write_shards(
    views: Iterable[Rendered],
    out: Path,
    largest: int = LARGEST,
    most: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Path]:
    """Write `shard-000.zip` and so on, each of at most `largest` bytes.

    `most`: the maximum number of shards.
    """
    out.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    archive: zipfile.ZipFile | None = None
    size = 0
    for done, files in enumerate(_encoded(views), start=1):
        bytes_here = sum(len(data) + 2 * len(name) + 200 for name, data in files.items())
        if archive is None or size + bytes_here > largest:
            if archive is not None:
                archive.close()
            if most is not None and len(paths) == most:
                return paths
            paths.append(out / f"shard-{len(paths):03d}.zip")
            archive, size = zipfile.ZipFile(paths[-1], "w", zipfile.ZIP_STORED), 0
        for name, data in files.items():
            archive.writestr(name, data)
        size += bytes_here
        if progress:
            progress(done)
    if archive is not None:
        archive.close()
    return paths


def _encoded(views: Iterable[Rendered]) -> Iterator[dict[str, bytes]]:
    with ThreadPoolExecutor() as pool:
        yield from pool.map(encode_view, views)


def load_shards(folder: Path) -> Views:
    """Return all views of a folder of shards. Raises InputError where there is none."""
    paths = sorted(folder.glob("shard-*.zip"))
    if not paths:
        raise InputError(f"There are no shards in {folder}. Make some with `dior-rt train lumen pack`.")
    loaded: list[dict[str, Tensor]] = []
    with ThreadPoolExecutor() as pool:
        for path in paths:
            with zipfile.ZipFile(path) as archive:
                names = sorted({name.split("/")[0] for name in archive.namelist()})
                files = [
                    {
                        f: archive.read(f"{n}/{f}")
                        for f in ("colour.avif", "grey.avif", "ids.png", "head.json")
                    }
                    for n in names
                ]
            loaded += list(pool.map(decode_view, files))
    return Views(**{name: torch.stack([view[name] for view in loaded]) for name in loaded[0]})


def decode_view(files: dict[str, bytes]) -> dict[str, Tensor]:
    """Return one view's tensors, in the fields of `Views` without the first axis."""
    head = json.loads(files["head.json"])
    side, count = int(head["side"]), int(head["sources"])
    world = np.array(head["world"], bool)
    colour = tiles_of(np.asarray(Image.open(io.BytesIO(files["colour.avif"])).convert("RGB")), side)
    grey = tiles_of(np.asarray(Image.open(io.BytesIO(files["grey.avif"])).convert("L"))[..., None], side)
    worlds = int(world.sum())
    lumi = np.zeros((count, side, side, 3), np.uint8)
    lumi[world] = colour[count : count + worlds]
    lumi[~world] = np.repeat(grey[: count - worlds], 3, axis=3)
    ids = np.asarray(Image.open(io.BytesIO(files["ids.png"])))
    lumi[:, ids == SKY] = 0
    images = colour[:count]

    def planes(raster: Bytes) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(raster, -1, -3)))

    def filled(values: Tensor) -> Tensor:
        if len(values) >= SOURCES:
            return values[:SOURCES]
        return torch.cat([values, torch.zeros(SOURCES - len(values), *values.shape[1:], dtype=values.dtype)])

    return {
        "images": filled(planes(images)),
        "lumi": filled(planes(lumi)),
        "image_most": filled(torch.tensor(head["image_most"], dtype=torch.float32)),
        "lumi_most": filled(torch.tensor(head["lumi_most"], dtype=torch.float32)),
        "usable": filled(torch.ones(count, dtype=torch.bool)),
        "world": filled(torch.from_numpy(world)),
        "normal": planes(colour[count + worlds]),
        "albedo": planes(colour[count + worlds + 1]),
        "depth": planes(grey[count - worlds]),
        "depth_range": torch.tensor(head["depth_range"], dtype=torch.float32),
        "ids": torch.from_numpy(np.array(ids))[None],
        "slope": torch.tensor(head["slope"], dtype=torch.float32),
    }
