"""Compare ways to carry the light of a small grid over to a photo: the table of docs/kernels.md.

    python -m tools.compare_transfer [FOLDER]

Pairs of pictures of one view under two lights are reduced to a grid of about 64 x 64 cells; each method gets
the photo and both grids and has to make the second picture. FOLDER may hold real pairs: psbox/*.png (Xiong et
al., 12 lights on one object) and multi_illumination/*/dir_*_mip6.jpg (Murmann et al.). Without it, only
synthetic lights on the pictures that scikit-image ships are measured. PSNR in dB of the 8-bit result, mean
over the pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image
from skimage import data
from skimage.filters import gaussian, threshold_otsu

from dior_rt.grid import GridRule
from dior_rt.kernels import NumpyOps
from dior_rt.kernels.color import linear_to_srgb, srgb_to_linear
from dior_rt.kernels.transfer import EPSILON, LIGHTNESS, SIGMA
from tools.command import start

Array = np.ndarray
Method = Callable[[Array, Array, Array], Array]
OPS = NumpyOps()


# The pairs: (kind, photo, the same view relit, grid).


def real_pairs(folder: Path) -> Iterator[tuple[str, Array, Array, tuple[int, int]]]:
    def load(pattern: str) -> list[Array]:
        return [np.asarray(Image.open(path).convert("RGB")) for path in sorted(folder.glob(pattern))]

    # The second set is small, 93 x 62: a grid of 16 x 12 has cells of six pixels.
    for kind, pattern, grid in [
        ("psbox", "psbox/*.png", None),
        ("multi", "multi_illumination/*/dir_*_mip6.jpg", (12, 16)),
    ]:
        pictures = load(pattern)
        for k in range(0, len(pictures) - 5, 2):
            for a, b in ((k, k + 5), (k + 5, k)):
                yield kind, pictures[a], pictures[b], grid or GridRule().shape(*pictures[a].shape[:2])


def synthetic_pairs() -> Iterator[tuple[str, Array, Array, tuple[int, int]]]:
    """Real pictures under a smooth light, a light that stops at the picture's edges, and a cast shadow."""
    for name in ("astronaut", "coffee", "chelsea", "rocket"):
        photo = getattr(data, name)()[..., :3]
        linear, (height, width) = srgb_to_linear(photo / 255), photo.shape[:2]
        y, x = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
        bump = np.exp(-((x - 0.7) ** 2 + (y - 0.3) ** 2) / 0.05)[..., None]
        brightness = gaussian(linear @ [0.2, 0.7, 0.1], 1)[..., None]
        lights = {
            "smooth": 0.3 + bump * [1.5, 1.2, 0.8],
            "aligned": np.where(brightness > threshold_otsu(brightness), [1.2, 1.1, 1.0], [0.35, 0.4, 0.6]),
            "shadow": np.where((x + 0.3 * y > 0.6)[..., None], [1.1, 1.1, 1.1], [0.35, 0.4, 0.5]),
        }
        for kind, light in lights.items():
            relit = OPS.encode_srgb((linear * light).astype(np.float32), np.uint8)
            yield kind, photo, relit, GridRule().shape(height, width)


# The methods: (photo, source grid, relit grid) -> picture.


def log_quotient(source: Array, relit: Array) -> Array:
    return np.log((relit + np.float64(EPSILON)) / (source + np.float64(EPSILON)))


def apply(photo: Array, log_r: Array) -> Array:
    linear = srgb_to_linear(photo / 255)
    return OPS.encode_srgb(((linear + EPSILON) * np.exp(log_r) - EPSILON).astype(np.float32), np.uint8)


def copy(photo: Array, source: Array, relit: Array) -> Array:
    return photo


def upsampled_picture(photo: Array, source: Array, relit: Array) -> Array:
    return OPS.encode_srgb(spread(relit, photo.shape[:2], linear_taps).astype(np.float32), np.uint8)


def interpolated(taps: Callable) -> Method:
    return lambda photo, source, relit: apply(
        photo, spread(log_quotient(source, relit), photo.shape[:2], taps)
    )


def guided(radius: int, regular: float) -> Method:
    """log R = a * lightness + b fitted in windows of the grid; a and b interpolated (He and Sun, 2015)."""

    def method(photo: Array, source: Array, relit: Array) -> Array:
        def mean(x: Array) -> Array:
            padded = np.pad(x, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
            windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * radius + 1,) * 2, (0, 1))
            return windows.mean((-1, -2))

        g, log_r = (linear_to_srgb(source) @ LIGHTNESS)[..., None], log_quotient(source, relit)
        slope = (mean(g * log_r) - mean(g) * mean(log_r)) / (mean(g * g) - mean(g) ** 2 + regular)
        offset = mean(log_r) - slope * mean(g)
        slope, offset = (spread(mean(x), photo.shape[:2], linear_taps) for x in (slope, offset))
        return apply(photo, slope * (photo / 255 @ LIGHTNESS)[..., None] + offset)

    return method


def bilateral(taps: Callable, sigma: float = SIGMA) -> Method:
    """Joint bilateral upsampling, without the sharpening that the kernel does."""

    def method(photo: Array, source: Array, relit: Array) -> Array:
        cells, pixels = linear_to_srgb(source) @ LIGHTNESS, photo / 255 @ LIGHTNESS
        return apply(
            photo,
            spread(
                log_quotient(source, relit),
                photo.shape[:2],
                taps,
                lambda cell: 1 / (1 + ((pixels - cells[cell]) / sigma) ** 2),
            ),
        )

    return method


def nearest_tap(at: Array) -> list[tuple[Array, Array]]:
    return [(np.floor(at + 0.5).astype(int), np.ones_like(at))]


def linear_taps(at: Array) -> list[tuple[Array, Array]]:
    lower = np.floor(at).astype(int)
    return [(lower, 1 - at + lower), (lower + 1, at - lower)]


def quadratic_taps(at: Array) -> list[tuple[Array, Array]]:
    middle = np.floor(at + 0.5).astype(int)
    d = at - middle
    return [(middle - 1, 0.5 * (0.5 - d) ** 2), (middle, 0.75 - d * d), (middle + 1, 0.5 * (0.5 + d) ** 2)]


def cubic_taps(at: Array) -> list[tuple[Array, Array]]:
    lower = np.floor(at).astype(int)
    d = np.abs(at - lower - np.arange(-1, 3)[:, None])
    weight = np.where(d < 1, 4 - 6 * d**2 + 3 * d**3, np.maximum(2 - d, 0) ** 3) / 6
    return [(lower + k - 1, weight[k]) for k in range(4)]


def spread(cells: Array, size: tuple[int, int], taps: Callable, likeness: Callable | None = None) -> Array:
    """(h, w, c) -> (H, W, c): the mean of the cells around each pixel, weighted by place and likeness."""
    total, weights = 0, 0
    rows, columns = (
        [
            (np.clip(cell, 0, n - 1), weight)
            for cell, weight in taps((np.arange(length) + 0.5) * n / length - 0.5)
        ]
        for n, length in zip(cells.shape[:2], size, strict=True)
    )
    for row, down in rows:
        for column, across in columns:
            cell = row[:, None], column
            weight = down[:, None] * across * (likeness(cell) if likeness else 1)
            total = total + weight[..., None] * cells[cell]
            weights = weights + weight[..., None]
    return total / weights


METHODS: dict[str, Method] = {
    "the photo itself": copy,
    "relit grid, bilinear": upsampled_picture,
    "log R, nearest cell": interpolated(nearest_tap),
    "log R, bilinear": interpolated(linear_taps),
    "guided 3 x 3, 0.01": guided(1, 0.01),
    "guided 3 x 3, 0.001": guided(1, 0.001),
    "bilateral 2 x 2": bilateral(linear_taps),
    "bilateral 3 x 3": bilateral(quadratic_taps),
    "bilateral 4 x 4": bilateral(cubic_taps),
    "**Ops.transfer**": OPS.transfer,
}


def psnr(a: Array, b: Array) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def leak(method: Method) -> int:
    """Codes by which the worst pixel is off, beside an edge between two flats that are lit differently."""
    worst = 0
    for edge in range(250, 266):
        photo = (
            np.where(np.arange(512) < edge, 60, 200)
            .astype(np.uint8)[None, :, None]
            .repeat(64, 0)
            .repeat(3, 2)
        )
        light = np.log(np.where(np.arange(512) < edge, 1.6, 0.4))[:, None]
        target = apply(photo, light)
        grids = (OPS.reduce_photo(picture, (8, 64)) for picture in (photo, target))
        worst = max(worst, int(np.abs(method(photo, *grids).astype(int) - target).max()))
    return worst


def main(
    folder: Annotated[Path | None, typer.Argument(help="Real pairs, beside the synthetic ones.")] = None,
) -> None:
    """Compare ways to carry the light of a small grid over to a photo, as a Markdown table."""
    pairs = [*(real_pairs(folder) if folder else ()), *synthetic_pairs()]
    kinds = list(dict.fromkeys(kind for kind, *_ in pairs))
    print("| method |", " | ".join(kinds), "| leak |")
    print("|---|" + "---|" * (len(kinds) + 1))
    for name, method in METHODS.items():
        scores: dict[str, list[float]] = {kind: [] for kind in kinds}
        for kind, photo, target, grid in pairs:
            grids = (OPS.reduce_photo(picture, grid) for picture in (photo, target))
            scores[kind].append(psnr(method(photo, *grids), target))
        print(
            f"| {name} |", " | ".join(f"{np.mean(scores[kind]):.2f}" for kind in kinds), f"| {leak(method)} |"
        )


if __name__ == "__main__":
    start(main)
