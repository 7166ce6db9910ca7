"""Relight a photo: the steps from the pixels of the photo to those of the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any, TypeGuard, Unpack

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt import __version__
from dior_rt.bundle import Bundle, default_bundle, read_bundle
from dior_rt.errors import Cancelled, DeviceError, InputError
from dior_rt.families import open_family
from dior_rt.flow.adaptive import sample_within
from dior_rt.flow.sampler import Array, State, Velocity, between, draw_noise, sample
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.images.arrays import (
    Picture,
    check_same_shape,
    like_photo,
    primaries_of,
    read_pixels,
    read_strokes,
    to_8_bits,
    to_primaries,
)
from dior_rt.images.primaries import Matrix, conversion, srgb
from dior_rt.kernels import KernelError, Stroke, Strokes, open_ops
from dior_rt.kernels.types import STRONGEST
from dior_rt.light import decode_small
from dior_rt.lights import Composed, Cover, Light, compose, cover
from dior_rt.presets import ALWAYS, REFERENCE, read_presets
from dior_rt.reach import check_reach, closeness, fade
from dior_rt.sampling import DEFAULTS, Sampling, SamplingFields, SamplingOptions, resolve_sampling
from dior_rt.stopwatch import Stopwatch

Progress = Callable[[int, int], bool | None]
#: The ways to draw light: light and mask, strokes as lines, an RGBA picture, or layers.
Drawing = Strokes | Sequence[Stroke] | Picture | Sequence[Light]

MOST_COVERS = 64  # layers whose light grids an open photo keeps

MOST_SIZES = 4  # preview sizes at which an open photo is kept

CANVAS = 2048  # pixels of the longest side on which strokes passed as lines are drawn

NOTHING_DRAWN = "The strokes specify nothing, so the photo is unchanged."


@contextmanager
def _device_errors() -> Iterator[None]:
    """Turn the kernels' device errors, whenever they occur, into DeviceError. It is also a decorator."""
    try:
        yield
    except KernelError as error:
        raise DeviceError(str(error)) from error


@dataclass(frozen=True)
class Relit:
    """A relit photo and the settings that made it.

    picture: of the photo's kind, dtype and size. notice: a sentence for the user, or None. seconds: by stage
    (kernels, steps, transfer). steps: the number of steps taken. sampling, seed, intensity, reach: as used.
    """

    picture: Picture
    notice: str | None
    seconds: dict[str, float]
    steps: int
    sampling: Sampling
    seed: int
    intensity: float
    reach: float | None

    @property
    def guidance(self) -> float:
        """Return the scale that was used."""
        return self.sampling.guidance

    def facts(self) -> dict[str, Any]:
        """Return the settings that decided the result, for its metadata."""
        used = {"steps": self.steps, "seed": self.seed, "intensity": self.intensity, "reach": self.reach}
        return {**self.sampling.facts(), **used}


class Relighter:
    """A model on a device: load once, relight many. Safe to use from several threads.

        relighter = Relighter()
        relit = relighter.relight(Image.open("photo.jpg"), Image.open("strokes.png"))
        relit.picture.save("relit.png")

    device, ops: what runs the network and the pixel kernels; device_reason, ops_reason: why these.
    """

    def __init__(
        self,
        bundle: Path | str | None = None,
        device: str = "auto",
        ops: str = "auto",
        threads: int | None = None,
    ) -> None:
        """Load a bundle; None is the one that ships with the package.

        device: for the network, "auto", "cpu", "cuda" ... ops: "auto", "numpy", "opencl", "opencl:<which>".
        threads: CPU threads for the network. Raises BundleError, and DeviceError for a device that is not
        there or computes wrong results.
        """
        self._bundle = read_bundle(Path(bundle) if bundle else default_bundle())
        with ThreadPoolExecutor(1) as pool:  # a cold device compiles its kernels while the network loads
            opening = pool.submit(open_ops, ops)
            self._family = open_family(self.bundle, device, threads)
            with _device_errors():
                self._ops = opening.result()
        self.device, self.device_reason = self._family.device, self._family.reason

    @property
    def bundle(self) -> Bundle:
        """Return the bundle that was loaded."""
        return self._bundle

    @property
    def ops(self) -> str:
        """Return what runs the pixel kernels.

        Under "auto" NumPy replaces a device that computes wrong results.
        """
        return self._ops.name

    @property
    def ops_reason(self) -> str:
        return self._ops.reason

    @property
    def ops_notice(self) -> str:
        """Return a notice about that choice for the user, such as a driver that crashes, or "" for none."""
        return self._ops.notice

    @property
    def presets(self) -> tuple[str, ...]:
        """Return the names that `relight` takes as its preset. Raises BundleError."""
        return REFERENCE, *read_presets(self.bundle)

    def facts(self) -> dict[str, Any]:
        """Return what determines its results, for their metadata.

        The manifest's hash covers those of all files.
        """
        return {
            "version": __version__,
            "bundle": self.bundle.manifest.name,
            "bundle_sha256": self.bundle.sha256,
            "device": self.device,
            "ops": self.ops,
        }

    def open(self, photo: Picture, primaries: Matrix | None = None) -> OpenPhoto:
        """Prepare a photo to be relit many times. Whatever depends only on the photo is computed once.

        photo: as `relight` takes it. primaries: the photo's own, to which drawn light is converted; None:
        those of a Pillow image's profile, else sRGB's. Raises InputError.
        """
        return OpenPhoto(self, photo, primaries)

    def relight(
        self,
        photo: Picture,
        strokes: Drawing,
        options: SamplingOptions = DEFAULTS,
        *,
        seed: int = 0,
        intensity: float = 1.0,
        reach: float | None = None,
        progress: Progress | None = None,
        **fields: Unpack[SamplingFields],
    ) -> Relit:
        """Return the photo under the light of the strokes.

        photo: a Pillow image, which is read as its file would be (upright by its EXIF, in the colours of its
          profile); or an array (H, W, 3), sRGB, of uint8, uint16, or float32 in 0..1.
        strokes: one of
          - Strokes, or RGBA as a Pillow image or an array (H, W, 4), shaped like the photo or like its light
            grid, of any size; alpha 0 = unspecified, integers are sRGB-encoded and floats linear;
          - a list of Stroke, in pixels of the photo;
          - a list of Light, which `dior_rt.lights` composes with the light on the photo.
        options: how the flow is sampled. The fields of SamplingOptions may also be given as keywords, such
          as preset="fast" or steps=4; a keyword takes precedence.
        seed: of the starting noise.
        intensity: multiplies the light of the strokes, >= 0.
        reach: how far from the strokes light changes, in longer sides of the photo, see `within_reach`;
          None leaves it to the model, or to each Light.
        progress: called after each step with (step, steps); it may skip steps where the solver chooses its
          own. Returning False stops with Cancelled.

        Raises InputError for what cannot be used, and DeviceError where a device fails.
        """
        opened = self.open(photo)
        return opened.relight(
            strokes, options, seed=seed, intensity=intensity, reach=reach, progress=progress, **fields
        )

    @_device_errors()
    def estimate(
        self,
        photo: Picture,
        options: SamplingOptions = DEFAULTS,
        *,
        seed: int = 0,
        progress: Progress | None = None,
        **fields: Unpack[SamplingFields],
    ) -> Array:
        """Return the photo's source Lumi map (h, w, 3) on its light grid, linear float32 >= 0.

        Arguments and errors are those of `relight`; guidance is 1, because there are no strokes.
        """
        how = resolve_sampling(self.bundle, replace(options.override(**fields), guidance=1.0))
        _check_seed(seed)
        pixels = read_pixels(photo)
        raster = self._family.raster(*pixels.shape[:2])
        _, encoded = self._family.reduce_photo(pixels, raster, self._ops)
        return self._estimate(encoded, how, seed, progress)

    def _fast(self, **asked: Any) -> Sampling:
        """Return the sampling of the fast preset, or of the reference where the model has none."""
        preset = "fast" if "fast" in self.presets else None
        return resolve_sampling(self.bundle, SamplingOptions(preset=preset, **asked))

    def _estimate(self, encoded: Array, how: Sampling, seed: int, progress: Progress | None) -> Array:
        condition = self._family.encode(encoded, None, "estimate")
        x0, _ = self._sample(condition, how, seed, progress)
        return self._family.decode_lumi(x0, condition)

    def _reduce_strokes(
        self,
        strokes: Strokes | Sequence[Stroke] | Picture,
        size: tuple[int, int],
        raster: tuple[int, int],
        intensity: float,
    ) -> Strokes:
        if isinstance(strokes, Sequence):
            strokes = self._draw(strokes, size)
        light, mask = read_strokes(strokes)
        if mask.shape != raster:
            check_same_shape(mask.shape, size)
        drawn = self._ops.reduce_strokes(light, mask, raster)
        # float64 holds the product of any allowed strokes and intensity.
        light = drawn.light.astype(np.float64) * intensity
        drawn = Strokes(light.clip(max=STRONGEST).astype(np.float32), drawn.mask)
        if not light.max() <= STRONGEST:
            raise InputError("The strokes' light is too strong to be computed with; lower the intensity.")
        return drawn

    def _draw(self, strokes: Sequence[Stroke], size: tuple[int, int]) -> Strokes:
        # The raster is far finer than any light grid, and bounded, however large the photo is.
        scale = min(1.0, CANVAS / max(size))
        canvas = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
        down, across = canvas[0] / size[0], canvas[1] / size[1]
        drawn = [
            replace(
                stroke,
                points=tuple((x * across, y * down) for x, y in stroke.points),
                width=stroke.width * scale,
            )
            for stroke in strokes
        ]
        return self._ops.draw_strokes(drawn, canvas)

    def _sample(
        self, condition: Any, how: Sampling, seed: int, progress: Progress | None
    ) -> tuple[Array, int]:
        """Return the state at the end of the flow, and the number of steps that were taken."""
        noise = draw_noise(seed, self._family.noise_shape(condition))
        noise *= np.float32(how.noise_scale)
        taken = 0
        for state in self._states(condition, how, noise):
            taken += 1
            if progress and progress(state.step, state.steps) is False:
                raise Cancelled(f"Stopped after step {state.step} of {state.steps}.")
        return state.x, taken

    def _states(self, condition: Any, how: Sampling, noise: Array) -> Iterator[State]:
        if how.tolerance is None:
            sigmas = self._sigmas(condition, how.steps, how.shift)
            return sample(self._velocity(condition, sigmas, how), noise, sigmas, how.solver)
        # The search uses the reference's sigmas. A finer schedule ends nearer the image, and so gives
        # another answer.
        family, sigmas = self._family, self._sigmas(condition, self.bundle.manifest.steps, how.shift)

        def distance(one: Array, other: Array) -> float:
            """Return the RMS of the light grid's pictures, sRGB-encoded 0..1."""
            pictures = (family.decode_relit(x0, condition).astype(np.float64) for x0 in (one, other))
            return float(np.sqrt(np.mean(np.subtract(*pictures) ** 2)))

        velocity = self._velocity(condition, sigmas, how)
        return sample_within(how.tolerance, distance, velocity, noise, sigmas)

    def _sigmas(self, condition: Any, steps: int, shift: float | None) -> Array:
        return ShiftSchedule(shift).sigmas(steps) if shift else self._family.sigmas(steps, condition)

    def _velocity(self, condition: Any, sigmas: Array, how: Sampling) -> Velocity:
        guided = self._family.velocity(condition, sigmas, how.guidance)
        if how.interval == ALWAYS or how.guidance == 1:
            return guided
        return between(*how.interval, guided, self._family.velocity(condition, sigmas, 1.0))


class OpenPhoto:
    """One photo on a `Relighter`, to be relit many times. Safe to use from several threads.

        photo = relighter.open(Image.open("photo.jpg"))
        lamp = Light(drawn, blend="add", reach=0.2)
        photo.preview([lamp]).picture      # small and fast
        photo.relight([lamp]).picture      # the photo's size, every step

    photo: as it was given. size: (rows, columns).
    """

    def __init__(self, relighter: Relighter, photo: Picture, primaries: Matrix | None = None) -> None:
        """primaries: as `Relighter.open` takes them."""
        self.photo = photo
        self._relighter = relighter
        self._pixels = read_pixels(photo)
        self._primaries = primaries_of(photo) if primaries is None else primaries
        self.size: tuple[int, int] = self._pixels.shape[:2]
        self._raster = relighter._family.raster(*self.size)
        self._small: dict[int, NDArray] = {}
        self._covers: list[tuple[Strokes | tuple[Stroke, ...], Cover]] = []
        self._lock = Lock()

    @_device_errors()
    def relight(
        self,
        lights: Drawing,
        options: SamplingOptions = DEFAULTS,
        *,
        seed: int = 0,
        intensity: float = 1.0,
        reach: float | None = None,
        progress: Progress | None = None,
        **fields: Unpack[SamplingFields],
    ) -> Relit:
        """Return the photo under the lights, at full size: `Relighter.relight` explains each argument."""
        how = resolve_sampling(self._relighter.bundle, options.override(**fields))
        return self._relight(self._pixels, self.photo, lights, how, seed, intensity, reach, progress)

    @_device_errors()
    def preview(
        self,
        lights: Drawing,
        *,
        longest: int = 1024,
        steps: int | None = None,
        seed: int = 0,
        intensity: float = 1.0,
        reach: float | None = None,
        progress: Progress | None = None,
    ) -> Relit:
        """Return the photo under the lights, fast: at most `longest` pixels per side, by the model's fast
        preset.

        The light is that of `relight` with as many steps, because the light grid is that of the full photo.
        The picture is uint8, (rows, columns, 3).
        """
        if longest < 1:
            raise InputError(f"A preview must have at least 1 pixel a side, not {longest}.")
        how = self._relighter._fast(steps=steps)
        small = self.small(longest)
        return self._relight(small, small, lights, how, seed, intensity, reach, progress)

    def small(self, longest: int) -> NDArray[np.uint8]:
        """Return the photo itself at the size of a preview: uint8, (rows, columns, 3)."""
        scale = min(1.0, longest / max(self.size))
        height, width = (max(1, round(side * scale)) for side in self.size)
        with self._lock:
            if longest not in self._small:
                if len(self._small) >= MOST_SIZES:
                    self._small.clear()
                # For the eye alone, so Pillow's fast mean of the encoded values will do.
                image = Image.fromarray(to_8_bits(self._pixels))
                reduced = image.resize((width, height), Image.Resampling.BOX, reducing_gap=2.0)
                self._small[longest] = np.asarray(reduced)
            return self._small[longest]

    @_device_errors()
    def source_map(self) -> Array:
        """Return the model's estimate of the light on the photo: a Lumi map (h, w, 3), linear >= 0, of the
        light grid.
        """
        return self._source_map.copy()

    @_device_errors()
    def target_map(self, lights: Sequence[Light], *, intensity: float = 1.0) -> Strokes:
        """Return the light that the lights ask for, composed with the source map, on the light grid."""
        return self._compose(lights, intensity).target

    @cached_property
    def _reduced(self) -> tuple[Array, Array]:
        relighter = self._relighter
        source, encoded = relighter._family.reduce_photo(self._pixels, self._raster, relighter._ops)
        # The network sees nothing brighter than white; its ratio at white also serves brighter light.
        return source.clip(max=1), encoded

    @cached_property
    def _source_map(self) -> Array:
        how = self._relighter._fast(guidance=1.0)
        return self._relighter._estimate(self._reduced[1], how, seed=0, progress=None)

    def _relight(
        self,
        pixels: NDArray,
        like: Picture,
        lights: Drawing,
        how: Sampling,
        seed: int,
        intensity: float,
        reach: float | None,
        progress: Progress | None,
    ) -> Relit:
        relighter = self._relighter
        _check_seed(seed)
        _check_intensity(intensity)
        check_reach(reach)
        watch = Stopwatch()
        composed = self._target(lights, intensity, reach)
        if not composed.target.mask.any():
            unchanged = like_photo(pixels.copy(), like)
            return Relit(unchanged, NOTHING_DRAWN, watch.seconds, 0, how, seed, intensity, reach)
        source, encoded = self._reduced
        watch.lap("kernels")
        condition = relighter._family.encode(encoded, composed.target, "relight")
        x0, taken = relighter._sample(condition, how, seed, progress)
        watch.lap("steps")
        relit = decode_small(relighter._family.decode_relit(x0, condition))
        if composed.nearness is not None:
            relit = fade(source, relit, composed.nearness)
        picture = like_photo(relighter._ops.transfer(pixels, source, relit), like)
        watch.lap("transfer")
        return Relit(picture, None, watch.seconds, taken, how, seed, intensity, reach)

    def _target(self, lights: Drawing, intensity: float, reach: float | None) -> Composed:
        if _are_layers(lights):
            if reach is not None:
                lights = [replace(light, reach=light.reach or reach) for light in lights]
            return self._compose(lights, intensity)
        strokes = to_primaries(lights, self._primaries)
        drawn = self._relighter._reduce_strokes(strokes, self.size, self._raster, intensity)
        near = None if reach is None else closeness(drawn.mask > 0, reach)
        return Composed(drawn, near)

    def _compose(self, lights: Sequence[Light], intensity: float) -> Composed:
        lights = [replace(one, strength=one.strength * intensity) for one in lights if one.on]
        covers = [self._cover(light.drawn) for light in lights]
        if not any(layer.coverage.any() for layer in covers):  # the source map is computed only on demand
            nothing = np.zeros((*self._raster, 3), np.float32)
            return Composed(Strokes(nothing, nothing[..., 0]), None)
        return compose(self._source_map, lights, covers, conversion(srgb(), self._primaries))

    def _cover(self, drawn: Strokes | tuple[Stroke, ...]) -> Cover:
        """Return the layer on the light grid.

        It is cached, because most layers stay unchanged while one is drawn.
        """
        with self._lock:
            for source, layer in self._covers:
                if source is drawn:
                    return layer
        raster = drawn if isinstance(drawn, Strokes) else self._relighter._draw(drawn, self.size)
        light, mask = read_strokes(raster)
        if mask.shape != self._raster:
            check_same_shape(mask.shape, self.size)
        layer = cover(Strokes(light, mask), self._raster)
        with self._lock:
            self._covers = [(drawn, layer), *self._covers[: MOST_COVERS - 1]]
        return layer


def _are_layers(lights: Drawing) -> TypeGuard[Sequence[Light]]:
    """Return whether the strokes are layers. Raises InputError for a mixture."""
    if not isinstance(lights, Sequence):
        return False
    layers = [isinstance(one, Light) for one in lights]
    if any(layers) and not all(layers):
        raise InputError("Give either strokes or lights, not both in one list.")
    return any(layers)


def _check_intensity(intensity: float) -> None:
    if not (math.isfinite(intensity) and intensity >= 0):
        raise InputError(f"intensity must be a number of at least 0, not {intensity}.")


def _check_seed(seed: int) -> None:
    if seed < 0:
        raise InputError(f"seed must be at least 0, not {seed}.")
