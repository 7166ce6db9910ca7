"""One file a view: pictures and Lumi maps by light, and the scene maps.

Arrays of a file, linear light, half floats unless noted; K lights, the lamps first and the world, if it
lights enough, last:

    images      (K, H, W, 3)   the picture under each light alone
    lumi        (lamps, H, W)  Lumi maps of the white lamps: one value, as all lamps are white
    world_lumi  (H, W, 3)      the world's Lumi map, where there is one
    normals     (H, W, 3)      in the camera's space: x right, y up, z towards the camera; 0 in the sky
    depth       (H, W)         metres along the camera's axis; 0 in the sky
    albedo      (H, W, 3)      share of light that the surface sends back, diffuse and glossy together
    sky         (H, W)         share of a pixel that shows the panorama, 0 to 1
    ids         (H, W) uint16  the thing that is seen: 0 sky, k + 1 for thing k
    head        JSON, see `ViewHead`

Every light is so strong that its Lumi map's mean over the pixels that are not sky is MEAN_LUMI.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from dior_rt.errors import InputError
from dior_rt.files import reason, replacing

FORMAT: Final = 1
MEAN_LUMI: Final = 0.25
HALF_MAX: Final = 6e4
ARRAYS: Final = ("images", "lumi", "normals", "depth", "albedo", "sky", "ids")

Half = NDArray[np.float16]


@dataclass(frozen=True)
class ViewHead:
    """The description in a view's file.

    lights: one object per light, in the order of the images: kind, role, gobo; kind "world" comes last.
    roles: those of the objects, in the order of their ids. camera: at, fov in degrees, axes (rows right, up,
    backward).
    """

    seed: int
    view: int
    scene_kind: str
    split: str
    panorama: str
    lights: tuple[dict[str, Any], ...]
    roles: tuple[str, ...]
    camera: dict[str, Any]
    renderer: str


@dataclass(frozen=True, eq=False)
class View:
    """One scene from one camera, with arrays as the module describes them."""

    images: Half
    lumi: Half
    world_lumi: Half | None
    normals: Half
    depth: Half
    albedo: Half
    sky: Half
    ids: NDArray[np.uint16]
    head: ViewHead

    def lumi_maps(self) -> Half:
        """Return all Lumi maps in colour: (K, H, W, 3), in the order of the images."""
        lamps = np.repeat(self.lumi[..., None], 3, axis=-1)
        return lamps if self.world_lumi is None else np.concatenate([lamps, self.world_lumi[None]])


def save_view(path: Path, view: View) -> None:
    """Write the view whole or not at all. Raises InputError."""
    arrays = {name: getattr(view, name) for name in ARRAYS}
    if view.world_lumi is not None:
        arrays["world_lumi"] = view.world_lumi
    head = json.dumps({"format": FORMAT, **asdict(view.head)})
    with replacing(path) as file:
        np.savez_compressed(file, head=np.array(head), **arrays)


def load_view(path: Path) -> View:
    """Read what `save_view` wrote. Raises InputError for a file that is cut short, or of another kind."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            described = json.loads(str(stored["head"]))
            if described.pop("format") != FORMAT:
                raise ValueError("another version made it")
            head = ViewHead(**described)
            head = ViewHead(**{**described, "lights": tuple(head.lights), "roles": tuple(head.roles)})
            world = stored.get("world_lumi")
            arrays = {name: stored[name] for name in ARRAYS}
            if len(arrays["images"]) != len(arrays["lumi"]) + (world is not None):
                raise ValueError("pictures and Lumi maps differ in number")
            return View(**arrays, world_lumi=world, head=head)
    except (OSError, BadZipFile, EOFError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no view that can be used: {reason(error)}.") from error


def half(raster: NDArray[np.floating]) -> Half:
    """Return half floats within their range. NaN becomes 0."""
    return np.clip(np.nan_to_num(raster), -HALF_MAX, HALF_MAX).astype(np.float16)
