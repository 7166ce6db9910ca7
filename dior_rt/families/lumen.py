"""Lumen: the network that reads a photo's scene first and then completes the light that is drawn on it.

Data variable x0 of the flow, on a grid of some 128 x 128 cells, by the strokes' blend mode:

    set        2 encode(target Lumi map) - 1
    add        2 encode(added light / the brightest drawn) - 1
    multiply   log(factor) / 2

with encode(L) = log(1 + 8 L) / log 9. The picture follows from the lights by a quotient, see `log_ratio`.
"""

from __future__ import annotations

import threading
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.bundle import Bundle
from dior_rt.engine import Engine, open_engine
from dior_rt.errors import BundleError
from dior_rt.families import Mode
from dior_rt.flow.sampler import Array, Condition, Velocity, guide
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.kernels import Ops, Strokes
from dior_rt.kernels.color import linear_to_srgb
from dior_rt.light import BOUNCED, apply_log_ratio, decode_small, encode_lumi, lumi_from_x0

#: The scene graph's outputs; GIVEN: those that the light graph takes.
SCENE: Final = ("light", "normal", "depth", "sky", "albedo", "bounce", "fine", "half", "quarter", "tokens")
GIVEN: Final = ("light", "normal", "depth", "sky", "fine", "half", "quarter", "tokens")
SET: Final = 0  # the blend mode of strokes that say what the light is
SIDE: Final = 128
NEARBY: Final = SIDE / 10  # cells: how far light bounces to its surroundings


class Lumen:
    """A lumen bundle, loaded on a device: the `Family` whose condition is the light graph's inputs, by name.

    The scene of the last photo is kept, because a person draws on one photo many times.
    """

    def __init__(self, bundle: Bundle, device: str = "auto", threads: int | None = None) -> None:
        """Raises BundleError for a bundle that is no complete lumen, and what `open_engine` raises."""
        grid, schedule = bundle.manifest.grid, bundle.manifest.schedule
        if bundle.manifest.family != "lumen" or grid is None or not isinstance(schedule, ShiftSchedule):
            raise BundleError(f"{bundle.folder} is no complete bundle of the family lumen.")
        self._grid, self._schedule = grid, schedule
        self._light = open_engine(bundle, "light", device, threads)
        self._scene: Engine = open_engine(bundle, "scene", self._light.device, threads, keep=False)
        self.device, self.reason = self._light.device, self._light.reason
        self._last: tuple[bytes, Condition] | None = None
        self._lock = threading.Lock()

    def raster(self, height: int, width: int) -> tuple[int, int]:
        return self._grid.shape(height, width)

    def reduce_photo(self, pixels: NDArray, raster: tuple[int, int], ops: Ops) -> tuple[Array, Array]:
        linear = ops.reduce_photo(pixels, raster)
        return linear, np.clip(linear_to_srgb(linear), 0, 1).astype(np.float32)

    def encode(self, photo: Array, strokes: Strokes | None, mode: Mode) -> Condition:
        planes = _planes(photo)
        scene = self._read(planes)
        nothing = np.zeros_like(planes)
        drawn, mask = nothing, nothing[:, :1]
        if strokes is not None:
            drawn = _planes(np.where(strokes.mask[..., None] > 0, strokes.light, 0))
            mask = _planes(strokes.mask[..., None])
        return {
            "photo": planes,
            **scene,
            "drawn": drawn,
            "mask": mask,
            "blend": np.array([SET], np.int64),
            "far": np.zeros(1, np.int64),
        }

    def _read(self, photo: Array) -> Condition:
        """The scene of a photo (1, 3, h, w)."""
        key = repr(photo.shape).encode() + photo.tobytes()
        with self._lock:
            if self._last is None or self._last[0] != key:
                self._last = key, self._scene.run({"photo": photo})
            return self._last[1]

    def noise_shape(self, condition: Condition) -> tuple[int, ...]:
        return condition["photo"].shape

    def sigmas(self, steps: int, condition: Condition) -> Array:
        return self._schedule.sigmas(steps)

    def velocity(self, condition: Condition, sigmas: Array, guidance: float) -> Velocity:
        """As `Family.velocity`. The null is the photo's own light, which no step has to compute."""
        own = 2 * encode_lumi(condition["light"]) - 1
        if not condition["mask"].any() or guidance == 0:
            return lambda x, sigma: ((x - own) / np.float32(sigma)).astype(np.float32)
        binding = self._light.bind(
            {name: v for name, v in condition.items() if name not in ("albedo", "bounce")}
        )

        def drawn(x: Array, sigma: float) -> Array:
            return binding.run({"x": x, "sigma": np.full(len(x), sigma, np.float32)})["velocity"]

        if guidance == 1:
            return drawn

        def guided(x: Array, sigma: float) -> Array:
            return guide((x - own) / np.float32(sigma), drawn(x, sigma), guidance)

        return guided

    def decode_relit(self, x0: Array, condition: Condition) -> Array:
        light, bounce = condition["light"], condition["bounce"]
        ratio = log_ratio(light, lumi_from_x0(x0), bounce)
        relit = apply_log_ratio(decode_small(condition["photo"]), np.clip(ratio, -6, 6))
        # Light above display white stays: what the display clips is decided at the size of the photo.
        return _pixels(linear_to_srgb(relit).astype(np.float32))

    def decode_lumi(self, x0: Array, condition: Condition) -> Array:
        return _pixels(lumi_from_x0(x0))


def log_ratio(source: Array, target: Array, bounce: Array) -> Array:
    """(B, 3, h, w): the logarithm of how much the picture's light changes between two Lumi maps.

        log((T + B(T) + b) / (S + B(S) + b)),   B(L) = near * blur(L) + far * mean(L)

    bounce: (B, 2, h, w), the shares near and far.
    """
    return np.log(bounced(target, bounce) / bounced(source, bounce))


def bounced(light: Array, bounce: Array) -> Array:
    """Light (B, 3, h, w) with what has bounced."""
    near, far = bounce[:, :1], bounce[:, 1:]
    return (
        light
        + near * blur(light, NEARBY)
        + far * light.mean(axis=(2, 3), keepdims=True)
        + np.float32(BOUNCED)
    )


def blur(cells: Array, deviation: float) -> Array:
    """Blur (B, C, h, w) by a Gaussian of `deviation` cells; the border's weights are normalised."""
    down, across = (_gaussian(size, deviation) for size in cells.shape[2:])
    return np.asarray(down @ cells @ across.T, np.float32)


def _gaussian(size: int, deviation: float) -> Array:
    place = np.arange(size, dtype=np.float32)
    weights = np.exp(-0.5 * ((place[:, None] - place) / np.float32(deviation)) ** 2)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def _planes(pixels: Array) -> Array:
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], np.float32)


def _pixels(planes: Array) -> Array:
    return np.ascontiguousarray(planes[0].transpose(1, 2, 0))
