"""Mini: the small network that ships in the package. It predicts light on about 64 x 64 cells.

Data variable x0 of the flow: 4 (relit - photo) to relight, 2 encode(Lumi map) - 1 to estimate, where relit
and photo are sRGB-encoded and encode(L) = log(1 + 8 L) / log 9. In both, squared error is roughly perceptual.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dior_rt.bundle import Bundle
from dior_rt.engine import Engine, open_engine
from dior_rt.errors import BundleError
from dior_rt.families import Mode
from dior_rt.flow.sampler import Array, Condition, Velocity, guided
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.kernels import Ops, Strokes
from dior_rt.kernels.color import linear_to_srgb
from dior_rt.light import lumi_from_x0, relit_from_x0

MODES: Final[dict[Mode, int]] = {"relight": 0, "estimate": 1}
SEEN: Final = ("photo", "light", "mask")  # the inputs of the graph "encode" in a condition


class Mini:
    """A mini bundle, loaded on a device. Its condition is the network's inputs by name."""

    def __init__(self, bundle: Bundle, device: str = "auto", threads: int | None = None) -> None:
        """Load the bundle. Raises BundleError if it is no complete mini, and what `open_engine` raises."""
        grid, schedule = bundle.manifest.grid, bundle.manifest.schedule
        if bundle.manifest.family != "mini" or grid is None or not isinstance(schedule, ShiftSchedule):
            raise BundleError(f"{bundle.folder} is no complete bundle of the family mini.")
        self._grid, self._schedule = grid, schedule
        velocity = open_engine(bundle, "velocity", device, threads)
        self._graphs = Graphs(
            encode=open_engine(bundle, "encode", velocity.device, threads, keep=False), velocity=velocity
        )
        self.device, self.reason = velocity.device, velocity.reason

    def raster(self, height: int, width: int) -> tuple[int, int]:
        return self._grid.shape(height, width)

    def reduce_photo(self, pixels: NDArray, raster: tuple[int, int], ops: Ops) -> tuple[Array, Array]:
        linear = ops.reduce_photo(pixels, raster)
        return linear, np.clip(linear_to_srgb(linear), 0, 1).astype(np.float32)

    def encode(self, photo: Array, strokes: Strokes | None, mode: Mode) -> Condition:
        return encode(photo, strokes, mode)

    def noise_shape(self, condition: Condition) -> tuple[int, ...]:
        return condition["photo"].shape

    def sigmas(self, steps: int, condition: Condition) -> Array:
        return self._schedule.sigmas(steps)

    def velocity(self, condition: Condition, sigmas: Array, guidance: float) -> Velocity:
        return self._graphs.guided(condition, guidance)

    def decode_relit(self, x0: Array, condition: Condition) -> Array:
        return _pixels(relit_from_x0(x0, condition["photo"]))

    def decode_lumi(self, x0: Array, condition: Condition) -> Array:
        return lumi_from_x0(_pixels(x0))


def encode(photo: Array, strokes: Strokes | None, mode: Mode) -> Condition:
    """Return the network's inputs for a photo (h, w, 3), sRGB 0..1, and strokes on the same grid, or None."""
    nothing = Strokes(np.zeros_like(photo), np.zeros(photo.shape[:2], np.float32))
    strokes = strokes or nothing
    return {
        "photo": _planes(photo),
        "light": _planes(np.where(strokes.mask[..., None] > 0, strokes.light, 0)),
        "mask": _planes(strokes.mask[..., None]),
        "mode": np.array([MODES[mode]], np.int64),
    }


def null(condition: Condition) -> Condition:
    """Return the condition without strokes: the null branch of guidance."""
    return {**condition, **{name: np.zeros_like(condition[name]) for name in ("light", "mask")}}


class Graphs:
    """Mini's two graphs. encode: the features of photo and strokes, run once. velocity: run at every step.

    The features of the photo alone are cached for the last photo, because users relight one photo many times.
    """

    def __init__(self, encode: Engine, velocity: Engine) -> None:
        self.encode, self.velocity = encode, velocity
        self._blank, self._source_light = lru_cache(1)(self._look), lru_cache(1)(self._estimate)

    def guided(self, condition: Condition, guidance: float) -> Velocity:
        """Return the guided velocity under a condition: see `dior_rt.flow.sampler.guided`."""
        drawn, blank = self.branches(condition)
        return guided(self.bind, drawn, blank, guidance)

    def bind(self, features: Condition) -> Velocity:
        """Return the velocity for features, which are copied to the device once."""
        binding = self.velocity.bind(features)

        def velocity(x: Array, sigma: float) -> Array:
            return binding.run({"x": x, "sigma": np.full(len(x), sigma, np.float32)})["velocity"]

        return velocity

    def branches(self, condition: Condition) -> tuple[Condition, Condition]:
        """Return the features of photo and strokes, and those of the photo alone."""
        mode, seen = {"mode": condition["mode"]}, {name: condition[name] for name in SEEN}
        photo = seen["photo"].shape, seen["photo"].tobytes()
        blank = drawn = self._blank(*photo)
        if seen["mask"].any():
            drawn = self.encode.run({**seen, "own": self._source_light(*photo)})
        return {**mode, **drawn}, {**mode, **blank}

    def _look(self, shape: tuple[int, ...], photo: bytes) -> Condition:
        """Return the features of a photo alone, from the graph "encode"."""
        pixels = np.frombuffer(photo, np.float32).reshape(shape)
        seen = {"photo": pixels, "light": np.zeros_like(pixels), "mask": np.zeros_like(pixels[:, :1])}
        return self.encode.run({**seen, "own": np.zeros_like(pixels)})

    def _estimate(self, shape: tuple[int, ...], photo: bytes) -> Array:
        """Return the encoded light on a photo, against which drawn light is measured.

        This is one evaluation without strokes from a state of zeros.
        """
        asked: Condition = {
            "x": np.zeros(shape, np.float32),
            "sigma": np.ones(shape[0], np.float32),
            "mode": np.full(shape[0], MODES["estimate"], np.int64),
        }
        velocity: Array = self.velocity.run({**asked, **self._blank(shape, photo)})["velocity"]
        # At x = 0 and sigma = 1 the velocity is -x0, and x0 is 2 own - 1.
        return (np.float32(1) - velocity) / np.float32(2)


def _planes(pixels: Array) -> Array:
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], np.float32)


def _pixels(planes: Array) -> Array:
    return np.ascontiguousarray(planes[0].transpose(1, 2, 0))
