"""Photos: from file to file.

A file is written, read, relit (1 step, guidance 1, light on its left half) and written again, as the command
does. Its samples are compared with the same computation in float64, converted to the file's own curve.
Rounding to 8 bits alone costs half of 1/255; rounding to 16 bits costs 1/514 of that.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import png
import pytest
import tifffile
import twin
from float64_reference import unit
from PIL import ExifTags, Image

from dior_rt.bundle import default_bundle, read_bundle
from dior_rt.errors import InputError
from dior_rt.families.mini import Mini
from dior_rt.images.arrays import BRIGHTEST
from dior_rt.images.photo import read_photo, write_photo
from dior_rt.kernels import Strokes

sys.path.insert(0, str(Path(__file__).parents[1] / "runtime" / "images"))
import icc

CODES = {"fp32": 0.6, "fp16": 2.0, "int8": 10.0}
GAMMA = {"adobe": 563 / 256, "prophoto": 1.8}


@dataclass(frozen=True)
class Case:
    """save: writes the file. seen: (H, W, 3), 0..1 on the sRGB curve, upright. back: from there to the file's
    own curve. suffix: of both files."""

    save: Callable[[Path], object]
    seen: np.ndarray
    back: Callable[[np.ndarray], np.ndarray] = field(default=lambda v: v)
    suffix: str = ".png"
    bound: float = CODES["fp32"]


def scene(height: int = 40, width: int = 52, channels: int = 3) -> np.ndarray:
    """Smooth colours with noise, 8 bits: no two corners are alike."""
    y, x = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    waves = np.stack([np.sin(5 * x + c) * np.cos(3 * y * (c + 1)) for c in range(channels)], -1)
    values = 0.5 + 0.4 * waves + np.random.default_rng(5).normal(0, 0.05, waves.shape)
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)


def plain(pixels: np.ndarray) -> Case:
    return Case(lambda path: Image.fromarray(pixels).save(path), pixels / 255)


def flat(colour: tuple[int, int, int]) -> Case:
    return plain(np.broadcast_to(np.uint8(colour), (40, 52, 3)).copy())


NOISE = np.random.default_rng(6).integers(0, 256, (40, 52, 3), dtype=np.uint8)
CHECKERS = np.where(np.indices((40, 52)).sum(0)[..., None] % 2, 255, 0).astype(np.uint8).repeat(3, 2)
CONTENTS = {
    "all black": flat((0, 0, 0)),
    "all white": flat((255, 255, 255)),
    "one colour": flat((255, 0, 90)),
    "noise": plain(NOISE),
    "checkerboard at Nyquist": plain(CHECKERS),
    "1 x 1": plain(NOISE[:1, :1]),
    "1 x 4000": plain(np.random.default_rng(7).integers(0, 256, (1, 4000, 3), dtype=np.uint8)),
    "4000 x 1": plain(np.random.default_rng(8).integers(0, 256, (4000, 1, 3), dtype=np.uint8)),
}


def deep() -> np.ndarray:
    random = np.random.default_rng(9).integers(0, 257, (40, 52, 3))
    return (scene().astype(np.uint32) * 257 - random).clip(0, 65535).astype(np.uint16)


def deep_rgb() -> Case:
    def save(path: Path) -> None:
        with path.open("wb") as file:
            png.Writer(52, 40, bitdepth=16, greyscale=False).write(file, deep().reshape(40, -1))

    return Case(save, deep() / 65535, bound=0.02)


def deep_grey() -> Case:
    grey = deep()[..., 0]
    seen = np.repeat(grey[..., None] / 65535, 3, 2)
    return Case(lambda path: tifffile.imwrite(path, grey), seen, suffix=".tif", bound=0.02)


def grey() -> Case:
    values = scene()[..., 0]
    return Case(lambda path: Image.fromarray(values).save(path), np.repeat(values[..., None] / 255, 3, 2))


def cmyk() -> Case:
    inks = scene(channels=4)
    light = np.round((255.0 - inks[..., :3]) * (255.0 - inks[..., 3:]) / 255) / 255
    return Case(lambda path: Image.fromarray(inks, "CMYK").save(path), light, suffix=".tif")


def palette() -> Case:
    colours = np.random.default_rng(10).integers(0, 256, (32, 3), dtype=np.uint8)
    indices = scene()[..., 0] // 8

    def save(path: Path) -> None:
        image = Image.fromarray(indices, "P")
        image.putpalette(colours.tobytes())
        image.save(path)

    return Case(save, colours[indices] / 255)


def transparent() -> Case:
    rgba = scene(channels=4)
    return Case(lambda path: Image.fromarray(rgba).save(path), rgba[..., :3] / 255)


def oriented(orientation: int) -> Case:
    """A file whose EXIF makes it stand like `scene`."""
    turns = {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: a.swapaxes(0, 1)[::-1],
        7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
        8: lambda a: a.swapaxes(0, 1)[:, ::-1],
    }
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    stored = np.ascontiguousarray(turns[orientation](scene()))
    return Case(lambda path: Image.fromarray(stored).save(path, exif=exif.tobytes()), scene() / 255)


def wide(space: str, deeply: bool) -> Case:
    """A photo in primaries and a curve of its own."""
    samples, top = (deep(), 65535) if deeply else (scene(), 255)
    if space == "p3":
        profile, power = icc.rgb_profile(icc.DISPLAY_P3, icc.SRGB_CURVE), None
    else:
        primaries = icc.ADOBE_RGB if space == "adobe" else icc.PROPHOTO
        profile, power = icc.rgb_profile(primaries, icc.gamma(GAMMA[space])), round(GAMMA[space] * 256) / 256

    def save(path: Path) -> None:
        if deeply:
            tifffile.imwrite(path, samples, photometric="rgb", iccprofile=profile)
        else:
            Image.fromarray(samples).save(path, icc_profile=profile)

    seen = samples / top if power is None else twin.encode((samples / top) ** power)

    def back(v: np.ndarray) -> np.ndarray:
        return v if power is None else twin.decode(v) ** (1 / power)

    return Case(save, seen, back, ".tif" if deeply else ".png", 0.15 if deeply else CODES["fp32"])


KINDS = {
    "16-bit RGB": deep_rgb(),
    "16-bit grey": deep_grey(),
    "8-bit grey": grey(),
    "CMYK": cmyk(),
    "palette": palette(),
    "transparency": transparent(),
    "Display P3": wide("p3", False),
    "Adobe RGB": wide("adobe", False),
    "ProPhoto": wide("prophoto", False),
    "16-bit Adobe RGB": wide("adobe", True),
    "16-bit ProPhoto": wide("prophoto", True),
    **{f"EXIF orientation {k}": oriented(k) for k in range(1, 9)},
}


def strokes(size: tuple[int, int]) -> Strokes:
    """Warm light on the left half."""
    light = np.broadcast_to(np.float32((1.5, 1.0, 0.6)), (*size, 3))
    return Strokes(light, np.broadcast_to(np.arange(size[1]) <= size[1] / 2, size).astype(np.float32))


@pytest.fixture(scope="module")
def expected(family, network) -> Callable[[Case], np.ndarray]:
    """The file's samples, 0..1, by the whole way in float64; once for every different photo."""
    done: dict[bytes, np.ndarray] = {}

    def relit(case: Case) -> np.ndarray:
        key = case.seen.tobytes() + repr(case.seen.shape).encode()
        if key not in done:
            size = case.seen.shape[:2]
            done[key] = twin.relight(family, network, case.seen, strokes(size), seed=5, steps=1, guidance=1.0)
        return case.back(np.clip(done[key], 0, 1))

    return relit


def samples_of(path: Path) -> np.ndarray:
    """A written file's RGB samples as they are stored, 0..1."""
    if path.suffix == ".tif":
        return unit(tifffile.imread(path)[..., :3])
    width, height, rows, info = png.Reader(filename=str(path)).read()
    pixels = np.vstack(list(rows)).reshape(height, width, info["planes"])[..., :3]
    return pixels / (2.0 ** info["bitdepth"] - 1)


def relight_file(loaded, case: Case, folder: Path) -> np.ndarray:
    given, made = folder / f"given{case.suffix}", folder / f"made{case.suffix}"
    case.save(given)
    photo = read_photo(given)
    relit = loaded.relight(photo.pixels, strokes(photo.size), steps=1, guidance=1.0, seed=5)
    write_photo(made, photo.with_pixels(relit.picture), {})
    if photo.alpha is not None:
        np.testing.assert_array_equal(read_photo(made).alpha, photo.alpha)
    return samples_of(made)


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=[pytest.mark.slow] if "4000" in kind else []) for kind in (*CONTENTS, *KINDS)],
)
def test_every_kind_of_photo(relighter, ops, expected, hold, tmp_path, kind):
    case, name = {**CONTENTS, **KINDS}[kind], ops.name.split()[0]
    got = relight_file(relighter("fp32", name), case, tmp_path)
    hold(kind, name, 255 * got, 255 * expected(case), case.bound, "1/255")


@pytest.mark.parametrize("precision", ["fp16", "int8"])
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] if "4000" in kind else []) for kind in CONTENTS]
)
def test_every_content_in_every_precision(relighter, expected, hold, tmp_path, kind, precision):
    case = CONTENTS[kind]
    got = relight_file(relighter(precision, "numpy"), case, tmp_path)
    hold(kind, precision, 255 * got, 255 * expected(case), CODES[precision], "1/255")


def test_float_photos_of_any_brightness(relighter, ops, family, network, hold):
    """Samples far below and above what a display shows; the error is relative to the sample, at least 1."""
    loaded, name = relighter("fp32", ops.name.split()[0]), ops.name.split()[0]
    for factor, bound in {1e-40: 2e-5, 1e-6: 2e-5, 1.0: 2e-5, BRIGHTEST: 3e-3}.items():
        photo = (scene() / 255 * factor).astype(np.float32)
        got = loaded.relight(photo, strokes((40, 52)), steps=1, guidance=1.0, seed=5).picture
        want = twin.relight(family, network, photo, strokes((40, 52)), seed=5, steps=1, guidance=1.0)
        hold(
            f"floats, {factor:g} times normal", name, got, want, bound, "sample", np.maximum(np.abs(want), 1)
        )


@pytest.mark.parametrize("factor", [1.1 * BRIGHTEST, 1e20, np.inf, np.nan])
def test_a_float_photo_too_bright_is_refused(relighter, factor):
    with pytest.raises(InputError, match="finite"):
        relighter("fp32", "numpy").relight(np.full((40, 52, 3), factor, np.float32), strokes((40, 52)))


SIDE = 10_000  # 100 megapixels are 300 MB


@pytest.mark.slow
def test_a_hundred_megapixels(network, hold, tmp_path):
    """The command itself: its picture, in windows, and its memory."""
    given, drawn, made = (tmp_path / name for name in ("given.tif", "drawn.npy", "made.png"))
    tile = np.random.default_rng(11).integers(0, 4, (500, 500, 3), dtype=np.uint8)
    ramp = np.linspace(0, 250, SIDE).astype(np.uint8)[:, None, None]
    pixels = np.tile(tile, (SIDE // 500, SIDE // 500, 1)) + ramp
    Image.fromarray(pixels).save(given)
    shipped = read_bundle(default_bundle())
    family, scale = Mini(shipped, "cpu", 1), shipped.manifest.noise_scale
    grid = family.raster(SIDE, SIDE)
    sparse = strokes(grid)
    np.save(drawn, np.dstack([sparse.light, sparse.mask]))
    options = ["--steps", "1", "--guidance", "1", "--seed", "5", "--ops", "auto", "--device", "cpu"]
    # The process reads its own peak: what the system tells its parent counts the parent's memory as well.
    code = (
        "import sys; from dior_rt.cli import run; code = run(sys.argv[1:]); "
        "print(open('/proc/self/status').read()); sys.exit(code)"
    )
    command = [sys.executable, "-c", code, "relight", given, drawn, "-o", made, *options]
    status = subprocess.run(list(map(str, command)), check=True, capture_output=True, text=True).stdout
    peak = int(status.partition("VmHWM:")[2].split()[0]) / 1024
    hold("100 megapixels: peak memory", "--ops auto", peak, 0, 2000, "MB")

    source = twin.reduce_photo(pixels, grid)
    relit = twin.relight_grid(family, network, source, sparse, 5, steps=1, guidance=1.0, noise_scale=scale)
    got = read_photo(made).pixels
    for top, left in ((0, 0), (0, SIDE - 64), (SIDE // 2, SIDE // 2), (SIDE - 64, 0), (SIDE - 64, SIDE - 64)):
        window = np.s_[top : top + 64, left : left + 64]
        want = twin.transfer(pixels[window], source, relit, (SIDE, SIDE), (top, left))
        hold("100 megapixels", "--ops auto", got[window], 255 * np.clip(want, 0, 1), CODES["fp32"], "1/255")
