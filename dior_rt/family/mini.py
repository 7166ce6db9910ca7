"""Mini: the small network that ships in the package. It predicts light on a grid of some 64 x 64 cells.

Data variable x0 of the flow: 4 (relit - photo) to relight, 2 encode(Lumi map) - 1 to estimate, where relit
and photo are sRGB-encoded and encode(L) = log(1 + 8 L) / log 9: in both, squared error is what the eye sees.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from dior_rt.bundle import Bundle
from dior_rt.engine import Engine, open_engine
from dior_rt.errors import BundleError
from dior_rt.kernels import Strokes
from dior_rt.sampler import Array, Condition, Velocity
from dior_rt.schedule import ShiftSchedule

Mode = Literal["relight", "estimate"]
MODES: Final = {"relight": 0, "estimate": 1}
RELIT_SCALE: Final = np.float32(4)
LUMI_SCALE: Final = np.float32(8)


class Mini:
    """A mini bundle, loaded on a device. Safe to use from several threads."""

    def __init__(self, bundle: Bundle, device: str = "auto", threads: int | None = None) -> None:
        """Raises BundleError for a bundle that is no mini, and what `open_engine` raises."""
        manifest = bundle.manifest
        if (
            manifest.family != "mini"
            or manifest.grid is None
            or not isinstance(manifest.schedule, ShiftSchedule)
        ):
            raise BundleError(f"{bundle.folder} is no complete bundle of the family mini.")
        self.manifest, self.grid, self.schedule = manifest, manifest.grid, manifest.schedule
        self.engine = open_engine(bundle, "velocity", device, threads)

    def bind(self, condition: Condition) -> Velocity:
        """The network's velocity under a condition."""
        return bind(self.engine, condition)


def bind(engine: Engine, condition: Condition) -> Velocity:
    """The velocity of mini's graph under a condition, whose arrays go to the device once."""
    binding = engine.bind(condition)

    def velocity(x: Array, sigma: float) -> Array:
        return binding.run({"x": x, "sigma": np.full(len(x), sigma, np.float32)})["velocity"]

    return velocity


def encode(photo: Array, strokes: Strokes | None, mode: Mode) -> Condition:
    """The network's inputs for one picture.

    photo: (h, w, 3) sRGB-encoded grid, 0..1. strokes: of the same grid, or None for none.
    """
    height, width = photo.shape[:2]
    specified = np.zeros((height, width), np.float32) if strokes is None else strokes.mask
    light = np.zeros_like(photo) if strokes is None else strokes.light
    return {
        "photo": _planes(photo),
        "light": _planes(light * (specified > 0)[..., None]),
        "mask": _planes(specified[..., None]),
        "mode": np.array([MODES[mode]], np.int64),
    }


def null(condition: Condition) -> Condition:
    """The condition without its strokes: the null branch of guidance."""
    nothing = {name: np.zeros_like(condition[name]) for name in ("light", "mask")}
    return {**condition, **nothing}


def decode_relit(x0: Array, photo: Array) -> Array:
    """(1, 3, h, w) state -> the relit grid (h, w, 3), sRGB-encoded 0..1: clip(photo + x0 / 4)."""
    return np.clip(photo + _pixels(x0) / RELIT_SCALE, 0, 1)


def decode_lumi(x0: Array) -> Array:
    """(1, 3, h, w) state -> the Lumi map of the grid (h, w, 3), linear >= 0: encode's inverse."""
    encoded = np.maximum((_pixels(x0) + 1) / 2, 0)
    return np.expm1(encoded * np.log1p(LUMI_SCALE)) / LUMI_SCALE


def _planes(pixels: Array) -> Array:
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], np.float32)


def _pixels(planes: Array) -> Array:
    return np.ascontiguousarray(planes[0].transpose(1, 2, 0))
