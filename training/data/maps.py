"""Maps of a scene's light that replace the Lumi map, by the same renderer, to measure its value as control.

All are linear, by source, and additive in sources, like the Lumi map L, of which each gives up one thing:

    irradiance  E / pi, E the light that arrives at a surface straight from the source and bounced
    shading     picture / reflectance, so what the materials do to light besides: bounces, gloss, metal
    Phong map   straight light only, but sent back by a white surface with a highlight, so it turns with the
                view: (1 - s) L + s times a Blinn-Phong lobe (Blinn, SIGGRAPH 1977) of exponent n

Irradiance bounces off surfaces that keep their reflectance and lose their gloss: in such a scene, and in no
glossy one, a picture over the reflectance is E / pi in every pixel. The lobe is Beckmann's of roughness
sqrt(2 / (n + 2)), which has its width (Walter et al., EGSR 2007).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.files import make_folder
from dior_rt.training.data.render import (
    SAMPLES,
    VIEWS,
    Stage,
    View,
    bsdf_of,
    half_floats,
    load_shapes,
    lumi_map,
    mitsuba,
    picture,
    rays_for,
    render,
    unit_of,
)
from dior_rt.training.data.triplets import usable_sources
from dior_rt.training.scenes.scene import Camera, Material, Source, Thing, scene

Raster = NDArray[np.float32]

LUMI: Final = "lumi"
KINDS: Final = (LUMI, "irradiance", "shading", "phong")
SPECULAR: Final = 0.2  # s above
EXPONENT: Final = 32.0  # n above
DARKEST: Final = 1e-3  # reflectance used as divisor; no texture is as dark, only pixels behind a scene


@dataclass(frozen=True)
class Stages:
    """A scene's objects: as they are and white, all without gloss, and white with a highlight."""

    original_stage: Stage
    matte: Stage
    glossy: Stage

    @staticmethod
    def load(things: tuple[Thing, ...], specular: float = SPECULAR, exponent: float = EXPONENT) -> Stages:
        def white(_: Material) -> dict[str, Any]:
            return glossy_white(specular, exponent)

        def matte(material: Material) -> dict[str, Any]:
            return bsdf_of(replace(material, finish="matte", roughness=1.0))

        original_stage = Stage.load(things)
        return Stages(
            original_stage,
            replace(original_stage, original=load_shapes(things, matte)),
            replace(original_stage, white=load_shapes(things, white)),
        )


def glossy_white(specular: float, exponent: float) -> dict[str, Any]:
    """Return white with a highlight, for the renderer. `specular` of the reflected light lies in the lobe."""
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    lobe = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "beckmann",
        "alpha": math.sqrt(2 / (exponent + 2)),
    }
    return {"type": "twosided", "bsdf": {"type": "blendbsdf", "weight": specular, "0": matte, "1": lobe}}


@dataclass(frozen=True)
class Shot:
    """One source from one camera. resolution: pixels per side. samples: rays per pixel."""

    camera: Camera
    source: Source
    resolution: int
    samples: int
    seed: int = 0

    def _of(self, render: Callable[..., Raster], stage: Stage) -> Raster:
        return render(stage, self.camera, self.source, self.resolution, self.samples, self.seed)

    def lumi(self, stages: Stages) -> Raster:
        """Return the Lumi map, (H, W, 3)."""
        return self._of(lumi_map, stages.original_stage)

    def phong(self, stages: Stages) -> Raster:
        """Return the Phong map, (H, W, 3)."""
        return self._of(lumi_map, stages.glossy)

    def irradiance(self, stages: Stages, albedo: Raster) -> Raster:
        """Return (H, W, 3) E / pi. albedo: the result of `albedo`."""
        return over(self._of(picture, stages.matte), albedo)

    def shading(self, stages: Stages, albedo: Raster) -> Raster:
        """Return (H, W, 3) the picture over the reflectance. albedo: the result of `albedo`."""
        return over(self._of(picture, stages.original_stage), albedo)

    def albedo(self, stages: Stages) -> Raster:
        """Return (H, W, 3), the reflectance that the camera sees, whatever the source; 0 where it sees
        nothing.
        """
        wanted = {"type": "aov", "aovs": "albedo:albedo"}
        shapes, size = stages.matte.original, self.resolution
        return render(shapes, self.camera, self.source, wanted, size, self.samples, self.seed)[..., :3]


def over(image: Raster, albedo: Raster) -> Raster:
    """Return (H, W, 3) float32: the image divided by the reflectance."""
    return (image / np.maximum(albedo, np.float32(DARKEST))).astype(np.float32)


def with_maps(view: View, camera: int = 0, samples: int = SAMPLES) -> dict[str, View]:
    """Return a view of `render_scenes` under every kind of map, by kind: the same pictures, in the same
    units.

    camera: the scene's camera that took it. samples: the rays per pixel it was rendered with. Raises
    InputError where its Lumi map cannot be reproduced, because scene, camera or renderer have changed.
    """
    described = scene(view.seed, VIEWS)
    stages = Stages.load(described.things)
    maps: dict[str, list[NDArray[np.float16]]] = {kind: [] for kind in KINDS}
    usable = usable_sources(view)
    albedo = None
    for k, source in enumerate(described.sources):
        rays = rays_for(source, samples)
        shot = Shot(described.cameras[camera], source, view.lumi.shape[1], rays, seed=k)
        light = shot.lumi(stages)
        unit = unit_of(light)
        if not np.array_equal(half_floats(light * unit), view.lumi[k]):
            raise InputError(f"The render of scene {view.seed} was made by other code; render it anew.")
        # The noise of the maps must contain no information about the noise of the pictures.
        shot = replace(shot, seed=len(described.sources) + k)
        albedo = shot.albedo(stages) if albedo is None else albedo
        others = (
            shot.irradiance(stages, albedo),
            shot.shading(stages, albedo),
            shot.phong(stages),
        )
        # A source whose direct light misses everything that the camera sees is in no pair, whatever the map.
        seen = unit if usable[k] else 0.0
        for kind, raster in zip(KINDS, (light, *others), strict=True):
            maps[kind].append(half_floats(raster * (unit if kind == LUMI else seen)))
    return {kind: replace(view, lumi=np.stack(rasters)) for kind, rasters in maps.items()}


def render_maps(
    renders: Path,
    out: Path,
    views: int,
    first: int = 0,
    samples: int = SAMPLES,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render the views of a folder of renders to `out/<kind>/`, each with that map in place of the Lumi map.

    Takes each scene's view from the first camera, and `views` of these from `first` on. samples: the rays per
    pixel that the renders were made with. Existing files are kept. Raises InputError where there are too few,
    for the reasons that `with_maps` refuses, and where nothing can be written.
    """
    mitsuba()  # no folder is made where it is missing
    paths = sorted(renders.glob("[0-9]*-0.npz"))[first : first + views]
    if len(paths) < views:
        raise InputError(f"There are {len(paths)} scenes in {renders} from {first} on, fewer than {views}.")
    for kind in KINDS:
        make_folder(out / kind)
    for done, path in enumerate(paths):
        targets = {kind: out / kind / path.name for kind in KINDS}
        if not all(target.exists() for target in targets.values()):
            for kind, view in with_maps(View.load(path), samples=samples).items():
                view.save(targets[kind])
        if progress:
            progress(done + 1, views)
