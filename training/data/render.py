"""Renders: each source of a scene alone, as a picture with the scene's materials and as a Lumi map.

A Lumi map is the light that a white matte surface of albedo 1 in each surface's place sends back, straight
from the source and nothing bounced:

    L(p) = (1 / pi) * integral over the hemisphere at x_p of  L_src(x_p, w) * max(n . w, 0) dw

which is what a direct-light integrator returns when every surface is a diffuse reflector of reflectance 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.files import make_folder, reason, replacing
from dior_rt.training.data.denoise import Guides
from dior_rt.training.scenes.scene import SOURCES, Camera, Material, Mesh, Scene, Source, Thing, scene
from dior_rt.training.scenes.world import world

RESOLUTION = 96
SAMPLES = 8
BOUNCES = 4
VIEWS = 2  # per scene
FORMAT = 1
AROUND = ("dome", "sky")  # kinds of source that shine from everywhere
GUIDE_SAMPLES = 4
LIT = 0.12  # the least share of a view's pixels that a source must reach


@dataclass(frozen=True)
class Domain:
    """A domain of scenes, and how they are rendered.

    scene: makes a scene from a number and a count of cameras. prefix: of its files' names, because domains
    may share a folder. skips_dim_sources: whether to leave out sources that hardly light a view. denoised:
    whether renders are denoised.
    """

    scene: Callable[[int, int], Scene]
    prefix: str
    skips_dim_sources: bool
    denoised: bool


DOMAINS = {
    "plain": Domain(scene, "", skips_dim_sources=False, denoised=False),
    "world": Domain(world, "world", skips_dim_sources=True, denoised=True),
}


def mitsuba() -> Any:
    """Return the renderer, in the variant that needs nothing but its wheel.

    Shards, with one process per core, use all cores. The LLVM variant compiles anew for most scenes, which at
    these sizes costs as much time as it saves.
    """
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
        mi.set_log_level(mi.LogLevel.Error)
    return mi


@dataclass(frozen=True)
class View:
    """One scene from one camera, with each source alone.

    images, lumi: (sources, H, W, 3), linear; the strength of every source makes the mean of its Lumi map 1/4.
    kinds: those of the sources; sources that shine from everywhere come last.
    """

    images: NDArray[np.float16]
    lumi: NDArray[np.float16]
    kinds: tuple[str, ...]
    scene_kind: str
    seed: int

    def save(self, path: Path) -> None:
        """Write the view whole or not at all. Raises InputError."""
        head = {"format": FORMAT, "kinds": self.kinds, "scene_kind": self.scene_kind, "seed": self.seed}
        with replacing(path) as file:
            np.savez(file, images=self.images, lumi=self.lumi, head=np.array(json.dumps(head)))

    @staticmethod
    def load(path: Path) -> View:
        """Read what `save` wrote. Raises InputError for a file that is cut short, or of another kind."""
        try:
            with np.load(path, allow_pickle=False) as stored:
                head = json.loads(str(stored["head"]))
                if head["format"] != FORMAT:
                    raise ValueError("another version made it")
                kinds = tuple(head["kinds"])
                return View(stored["images"], stored["lumi"], kinds, head["scene_kind"], head["seed"])
        except (OSError, BadZipFile, EOFError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} is no render that can be used: {reason(error)}.") from error


def render_scenes(
    out: Path,
    scenes: int,
    seed: int,
    shard: tuple[int, int] = (0, 1),
    progress: Callable[[int, int], None] | None = None,
    domain: str = "plain",
) -> None:
    """Render the missing scenes, two views each, to `out/<scene>-<view>.npz`.

    domain: a name in DOMAINS. shard: (index, count), this process's share. Scene numbers are seed * 1,000,000
    + k for k in 0 .. scenes - 1, so that sets of different seeds share none. Raises InputError where nothing
    can be written, or for an unknown domain.
    """
    if domain not in DOMAINS:
        raise InputError(f"There is no domain {domain}; there are {', '.join(DOMAINS)}.")
    chosen = DOMAINS[domain]
    mitsuba()  # no folder is made where it is missing
    if chosen.denoised:
        import mitsuba_oidn  # noqa: F401
    make_folder(out)
    index, count = shard
    numbers = [seed * 1_000_000 + k for k in range(index, scenes, count)]
    for done, number in enumerate(numbers):
        paths = [out / f"{chosen.prefix}{number:09d}-{v}.npz" for v in range(VIEWS)]
        if not all(path.exists() for path in paths):
            described = chosen.scene(number, VIEWS)
            stage = Stage.load(described.things)
            for path, camera in zip(paths, described.cameras, strict=True):
                shown = lit(stage, described, camera) if chosen.skips_dim_sources else described
                view(stage, shown, camera, number, denoised=chosen.denoised).save(path)
        if progress:
            progress(done + 1, len(numbers))


@dataclass(frozen=True, eq=False)
class Shapes:
    """Objects in one set of materials, and the renderer's scenes of them under one source each.

    Building one costs as much as rendering it, so all cameras share it.
    """

    things: dict[str, Any]
    scenes: dict[int, tuple[Source | None, Any]] = field(default_factory=dict)

    def under(self, source: Source | None) -> Any:
        """Return the renderer's scene under that source, or in the dark."""
        if id(source) not in self.scenes:
            lights = {"source": emitter_of(source)} if source else {}
            loaded = mitsuba().load_dict({"type": "scene", **lights, **self.things})
            self.scenes[id(source)] = source, loaded  # with the source, so that it keeps its id
        return self.scenes[id(source)][1]


@dataclass(frozen=True)
class Stage:
    """A scene's objects as they are, and all white and matte.

    Loaded once, as loading costs as much as a render.
    """

    original: Shapes
    white: Shapes

    @staticmethod
    def load(things: tuple[Thing, ...]) -> Stage:
        return Stage(load_shapes(things, bsdf_of), load_shapes(things, _white))


def view(
    stage: Stage,
    described: Scene,
    camera: Camera,
    seed: int,
    resolution: int = RESOLUTION,
    samples: int = SAMPLES,
    denoised: bool = False,
) -> View:
    """Render one camera's view of every source, original and white."""
    guides = surfaces(stage, camera, resolution) if denoised else None
    images, lumi = [], []
    for k, source in enumerate(described.sources):
        rays = rays_for(source, samples)
        light = lumi_map(stage, camera, source, resolution, rays, seed=k)
        image = picture(stage, camera, source, resolution, rays, seed=k)
        if guides:
            light, image = guides.lumi_map(light), guides.picture(image)
        unit = unit_of(light)
        images.append(half_floats(image * unit))
        lumi.append(half_floats(light * unit))
    kinds = tuple(source.kind for source in described.sources)
    return View(np.stack(images), np.stack(lumi), kinds, described.kind, seed)


def lit(stage: Stage, described: Scene, camera: Camera) -> Scene:
    """Return the scene with the sources that light enough of a view.

    It keeps the first SOURCES local sources of this kind, and the environment if it qualifies. Where no
    source does, it keeps the one that lights most. A source that lights almost nothing would be noise after
    scaling to the common mean.
    """
    *local, environment = described.sources
    found = islice((source for source in local if reach(stage, camera, source) >= LIT), SOURCES)
    around = [environment] if reach(stage, camera, environment) >= LIT else []
    kept = (*found, *around) or (max(described.sources, key=partial(reach, stage, camera)),)
    return replace(described, sources=kept)


def reach(stage: Stage, camera: Camera, source: Source) -> float:
    """Return the share of a view's pixels that get more than a tenth of its mean light, by a quick probe."""
    probe = np.nan_to_num(lumi_map(stage, camera, source, resolution=32, samples=4)).mean(axis=2)
    return float((probe > 0.1 * probe.mean()).mean())


def surfaces(stage: Stage, camera: Camera, resolution: int) -> Guides:
    """Return the surfaces that the camera sees, for the denoiser."""
    integrator = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
    layers = render(stage.original, camera, None, integrator, resolution, GUIDE_SAMPLES, seed=0)
    return Guides(*(np.ascontiguousarray(np.nan_to_num(part)) for part in np.split(layers, 2, axis=2)))


def rays_for(source: Source, samples: int) -> int:
    """Return the rays per pixel for a source.

    Most rays of a source that shines from everywhere are blocked.
    """
    return 2 * samples if source.kind in AROUND else samples


def unit_of(light: NDArray[np.float32]) -> float:
    """Return the factor that brings a Lumi map to the common mean, which suits half floats.

    A source's strength is arbitrary until triplets mix it.
    """
    return 0.25 / max(float(light.mean()), 1e-6)


def half_floats(raster: NDArray[np.float32]) -> NDArray[np.float16]:
    """Return half floats, within their range. NaN becomes 0."""
    return np.clip(np.nan_to_num(raster), 0, 6e4).astype(np.float16)


def picture(
    stage: Stage, camera: Camera, source: Source, resolution: int, samples: int, seed: int = 0
) -> NDArray[np.float32]:
    """Return (H, W, 3) linear radiance with the scene's materials and bounced light."""
    integrator = {"type": "path", "max_depth": BOUNCES, "hide_emitters": True}
    return render(stage.original, camera, source, integrator, resolution, samples, seed)[..., :3]


def lumi_map(
    stage: Stage, camera: Camera, source: Source, resolution: int, samples: int, seed: int = 0
) -> NDArray[np.float32]:
    """Return (H, W, 3), the Lumi map of one source of radiance 1: white matte surfaces, direct light only."""
    integrator = {"type": "direct", "hide_emitters": True}
    return render(stage.white, camera, source, integrator, resolution, samples, seed)[..., :3]


def render(
    shapes: Shapes,
    camera: Camera,
    source: Source | None,
    integrator: dict[str, Any],
    resolution: int,
    samples: int,
    seed: int,
) -> NDArray[np.float32]:
    """Return (H, W, channels of the integrator) of the shapes under a source, or in the dark."""
    mi = mitsuba()
    sensor, integrate = mi.load_dict(_sensor(camera, resolution)), mi.load_dict(integrator)
    rendered = mi.render(shapes.under(source), sensor=sensor, integrator=integrate, spp=samples, seed=seed)
    return np.array(rendered, dtype=np.float32)


def load_shapes(things: tuple[Thing, ...], bsdf: Callable[[Material], dict[str, Any]]) -> Shapes:
    """Return the renderer's meshes of some objects, each with the material that `bsdf` makes of its own."""
    mi = mitsuba()
    return Shapes(
        {f"thing{k}": _mesh(thing.mesh, mi.load_dict(bsdf(thing.material))) for k, thing in enumerate(things)}
    )


def _mesh(mesh: Mesh, bsdf: Any) -> Any:
    mi = mitsuba()
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    loaded = mi.Mesh(
        "mesh",
        vertex_count=len(mesh.vertices),
        face_count=len(mesh.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(loaded)
    parameters["vertex_positions"] = mesh.vertices.ravel()
    parameters["vertex_texcoords"] = mesh.uv.ravel()
    parameters["faces"] = mesh.faces.ravel()
    parameters.update()
    return loaded


def _white(material: Material) -> dict[str, Any]:
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    return {"type": "twosided", "bsdf": _bumped(material, white)}


def _bumped(material: Material, surface: dict[str, Any]) -> dict[str, Any]:
    if material.relief is None:
        return surface
    heights = {"type": "bitmap", "bitmap": mitsuba().Bitmap(material.relief[..., None]), "raw": True}
    return {"type": "bumpmap", "heights": heights, "bsdf": surface}


def bsdf_of(material: Material) -> dict[str, Any]:
    """Return a material in the renderer's description."""
    mi = mitsuba()
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(material.reflectance), "raw": True}
    surface: dict[str, Any]
    if material.finish == "matte":
        surface = {"type": "diffuse", "reflectance": bitmap}
    elif material.finish == "plastic":
        surface = {"type": "roughplastic", "diffuse_reflectance": bitmap, "alpha": material.roughness}
    else:
        surface = {"type": "roughconductor", "specular_reflectance": bitmap, "alpha": material.roughness}
    return {"type": "twosided", "bsdf": _bumped(material, surface)}


def _sensor(camera: Camera, resolution: int) -> dict[str, Any]:
    mi = mitsuba()
    return {
        "type": "perspective",
        "fov": float(camera.fov),
        "to_world": mi.ScalarTransform4f().look_at(
            origin=camera.at.tolist(), target=camera.target.tolist(), up=[0, 1, 0]
        ),
        "film": {
            "type": "hdrfilm",
            "width": resolution,
            "height": resolution,
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def emitter_of(source: Source) -> dict[str, Any]:
    """Return a source in the renderer's description."""
    mi = mitsuba()
    radiance = {"type": "rgb", "value": 1.0}
    area = {"type": "area", "radiance": radiance}
    if source.kind == "dome":
        return {"type": "constant", "radiance": radiance}
    if source.kind == "sky":
        return {"type": "envmap", "bitmap": mi.Bitmap(source.panorama)}
    if source.kind == "sphere":
        return {"type": "sphere", "center": source.at.tolist(), "radius": source.size, "emitter": area}
    to_world = mi.ScalarTransform4f().look_at(
        origin=source.at.tolist(), target=source.target.tolist(), up=[0.0123, 1, 0.0321]
    )
    if source.kind == "spot":
        return {"type": "spot", "to_world": to_world, "intensity": radiance, "cutoff_angle": source.size}
    return {
        "type": "rectangle",
        "to_world": to_world @ mi.ScalarTransform4f().scale(source.size),
        "emitter": area,
    }
