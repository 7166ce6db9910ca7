"""Turn scenes into files: choose cameras and lamps, shoot, denoise, bring every light to one mean, and
store.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.files import make_folder
from dior_rt.training.blender.assets import Assets, Split
from dior_rt.training.blender.denoise import denoised
from dior_rt.training.blender.kinds import scene
from dior_rt.training.blender.lamps import lamps
from dior_rt.training.blender.probe import look, score
from dior_rt.training.blender.scene import BlenderScene, Camera, Lamp
from dior_rt.training.blender.store import MEAN_LUMI, View, ViewHead, half, save_view

if TYPE_CHECKING:
    from dior_rt.training.blender.cycles import ShootOptions, Shot, Studio

RENDERER: Final = "blender-3"
VIEWS: Final = 2  # per scene
GOOD: Final = 0.35  # the score at which the search for further cameras stops
LEAST_LIGHTS: Final = 3
LEAST_LIT: Final = 0.05  # the share of a view's pixels that a light must reach
LIT: Final = 0.1  # the share of a light's mean at which a pixel counts as reached

Raster = NDArray[np.float32]


@dataclass(frozen=True)
class Job:
    """The scenes to render. shard: (index, count), this process's share of the scenes."""

    out: Path
    assets: Path
    scenes: int
    seed: int
    shard: tuple[int, int] = (0, 1)
    split: Split = "train"


def numbers(job: Job) -> list[int]:
    """Return the seeds of this process's scenes. Sets of different --seed share none."""
    index, count = job.shard
    return [job.seed * 1_000_000 + k for k in range(index, job.scenes, count)]


def render_views(
    job: Job, options: ShootOptions, progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Render the missing scenes to `out/<split>-<seed>-<view>.npz`, VIEWS files each.

    A scene without a picture worth taking leaves an empty file `<split>-<seed>.done`, so that a later run
    does not try again. Raises InputError where the assets cannot be read or nothing can be written.
    """
    from dior_rt.training.blender.cycles import Studio

    assets = Assets.open(job.assets)
    make_folder(job.out)
    shard_numbers = numbers(job)
    for done, number in enumerate(shard_numbers):
        stem = f"{job.split}-{number:09d}"
        finished = job.out / f"{stem}.done"
        if not finished.exists():
            described = scene(number, assets, job.split, VIEWS)
            with Studio(described, assets.panorama_file(described.panorama.name), options) as studio:
                for k, view in enumerate(views(described, studio, VIEWS)):
                    save_view(job.out / f"{stem}-{k}.npz", view)
            try:
                finished.touch()
            except OSError as error:
                raise InputError(f"Cannot write {finished}: {error.strerror}.") from error
        progress(done + 1, len(shard_numbers))


def views(described: BlenderScene, studio: Studio, count: int) -> list[View]:
    """Return the scene's views that are worth keeping, at most `count`."""
    rng = np.random.default_rng([described.seed, 7])
    found = []
    for k, camera in enumerate(cameras(described, studio, count)):
        hits = look(studio, camera)
        chosen = lamps(described, camera, studio, hits, rng)
        if len(chosen) >= LEAST_LIGHTS - 1:
            shot = studio.shoot(camera, chosen)
            if view := finish(described, camera, chosen, shot, k):
                found.append(view)
    return found


def cameras(described: BlenderScene, studio: Studio, count: int) -> list[Camera]:
    """Return the best candidates: the first that are good, else the best of all, or none where none is a
    picture.
    """
    rated: list[tuple[float, Camera]] = []
    for camera in described.cameras:
        value = score(described, camera, look(studio, camera))
        if value > 0:
            rated.append((value, camera))
        if sum(one[0] > GOOD for one in rated) >= count:
            break
    return [camera for _, camera in sorted(rated, key=lambda one: -one[0])[:count]]


def finish(
    described: BlenderScene, camera: Camera, chosen: list[Lamp], shot: Shot, index: int
) -> View | None:
    """Denoise a shot and keep the lights that reach enough of it. Returns None where too few do."""
    seen = shot.sky < 0.5
    lights = [
        *(
            {"kind": lamp.kind, "role": lamp.role, "gobo": lamp.gobo.kind if lamp.gobo else None}
            for lamp in chosen
        )
    ]
    lights += [{"kind": "world", "role": "world", "gobo": None}] * (len(shot.lumi) - len(chosen))
    images, maps, kept = [], [], []
    white = np.repeat((1 - shot.sky)[..., None], 3, axis=2)
    for k, light in enumerate(lights):
        lumi = np.nan_to_num(shot.lumi[k])
        if light["kind"] != "world":
            lumi = np.repeat(lumi.mean(2, keepdims=True), 3, axis=2)
        if not reaches_enough(lumi, seen):
            continue
        lumi = denoised(lumi, white, shot.guide_normals) * seen[..., None]
        unit = MEAN_LUMI / float(lumi[seen].mean())
        maps.append(lumi * unit)
        images.append(denoised(np.nan_to_num(shot.images[k]), shot.guide_albedo, shot.guide_normals) * unit)
        kept.append(light)
    if len(kept) < LEAST_LIGHTS:
        return None
    world = maps.pop() if kept[-1]["kind"] == "world" else None
    length = np.linalg.norm(shot.normals, axis=2, keepdims=True)
    normals = shot.normals / np.maximum(length, 1e-6) * (length > 0.1) @ camera.axes().T
    return View(
        images=half(np.stack(images)),
        lumi=half(np.stack(maps).mean(3)),
        world_lumi=None if world is None else half(world),
        normals=half(normals * seen[..., None]),
        depth=half(np.where(seen, shot.depth, 0)),
        albedo=half(shot.albedo),
        sky=half(shot.sky),
        ids=np.rint(shot.ids).astype(np.uint16),
        head=head(described, camera, kept, index),
    )


def head(described: BlenderScene, camera: Camera, lights: list[dict[str, Any]], index: int) -> ViewHead:
    """Return the description of a view for its file."""
    return ViewHead(
        seed=described.seed,
        view=index,
        scene_kind=described.kind,
        split=described.split,
        panorama=described.panorama.name,
        lights=tuple(lights),
        roles=tuple(thing.role for thing in described.things),
        camera={"at": camera.at, "fov": camera.fov, "axes": camera.axes().tolist()},
        renderer=RENDERER,
    )


def reaches_enough(lumi: Raster, seen: NDArray[np.bool_]) -> bool:
    """Return whether a light shines on LEAST_LIT of the view's surfaces."""
    if not seen.any():
        return False
    value = lumi.mean(2)[seen]
    mean = float(value.mean())
    return mean > 1e-6 and float((value > LIT * mean).mean()) >= LEAST_LIT
