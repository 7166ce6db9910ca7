"""Encode a prompt and its pictures for the transformer: Qwen2.5-VL, layer by layer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt.families.qwen.frame import fit_area, resize
from dior_rt.families.qwen.layers import Layers
from dior_rt.families.qwen.rope import grid_places, rates, turns
from dior_rt.families.qwen.settings import TextSettings, VisionSettings

Array = NDArray[np.float32]
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Features:
    """The vision tower's features of one picture: (rows * columns, D), row by row."""

    values: Array
    rows: int
    columns: int


class PromptEncoder:
    """The encoder of a bundle's prompts. words: word id -> its embedding (D,)."""

    def __init__(self, settings: TextSettings, words: Mapping[int, Array], layers: Layers) -> None:
        self._settings, self._words, self._layers = settings, words, layers

    def look(self, pictures: Sequence[Picture]) -> list[Features]:
        """Return the features of sRGB pictures (h, w, 3)."""
        vision = self._settings.vision
        seen = [patchify(vision, picture) for picture in pictures]
        grids = [grid for _, grid in seen]
        order, windows = window_order(vision, grids)
        patches = _in_order(np.concatenate([patches for patches, _ in seen]), order, vision.merge)
        places = np.concatenate([patch_places(vision, grid) for grid in grids])
        cos, sin = turns(_in_order(places, order, vision.merge), (vision.head // 2,) * 2, vision.theta)
        whole = np.repeat(np.arange(len(grids)), [rows * columns for rows, columns in grids])

        x = self._layers.run("vision.embed", {"patches": patches})["out"]
        for index in range(vision.blocks):
            groups = whole if index in vision.whole_blocks else windows
            feeds = {"x": x, "cos": cos, "sin": sin, "groups": groups}
            x = self._layers.run(f"vision.block.{index:02}", feeds)["out"]
        merged = self._layers.run("vision.merge", {"x": x})["out"]
        values = np.empty_like(merged)
        values[order] = merged
        sizes = [(rows // vision.merge, columns // vision.merge) for rows, columns in grids]
        parts = np.split(values, np.cumsum([rows * columns for rows, columns in sizes])[:-1])
        return [Features(part, *size) for part, size in zip(parts, sizes, strict=True)]

    def encode(self, prompt: str, features: Sequence[Features]) -> Array:
        """Return the embeddings (T, D) of the named prompt, which refers to these pictures in this order."""
        text = self._settings
        x, places = self._sequence(text.prompts[prompt], features)
        cos, sin = section_turns(places, text.head, text.sections, text.theta)
        for index in range(text.blocks):
            x = self._layers.run(f"text.block.{index:02}", {"x": x, "cos": cos, "sin": sin})["out"]
        return self._layers.run("text.norm", {"x": x})["out"][text.skip :]

    def _sequence(self, ids: Sequence[int], features: Sequence[Features]) -> tuple[Array, NDArray[np.int64]]:
        """Return words and features in sequence, and their positions (tokens, 3).

        A word is one position after its predecessor. A picture's features have their positions in the
        picture; the next word is beyond its longer side.
        """
        parts, places, place, pictures = [], [], 0, iter(features)
        for word in ids:
            if word == self._settings.picture_id:
                picture = next(pictures)
                parts.append(picture.values)
                places.append(place + grid_places(picture.rows, picture.columns, frame=0))
                place += max(picture.rows, picture.columns)
            else:
                parts.append(self._words[word][None])
                places.append(np.full((1, 3), place))
                place += 1
        return np.concatenate(parts), np.concatenate(places)


def section_turns(
    places: NDArray[np.int64], head: int, sections: Sequence[int], theta: float
) -> tuple[Array, Array]:
    """Return cos and sin (tokens, head / 2), with the rates divided among frame, row and column."""
    axis = np.repeat(np.arange(len(sections)) % 3, sections)
    angles = places[:, axis].astype(np.float32) * rates(head, theta)
    return np.cos(angles), np.sin(angles)


def patchify(vision: VisionSettings, picture: Picture) -> tuple[Array, tuple[int, int]]:
    """Return the patches (rows * columns, 3 * frames * patch^2) of a picture (h, w, 3), and (rows, columns).

    The picture is resized to about `area` by Lanczos, then to full patches by bicubic, as the model's two
    processors do. Patches that will be merged are adjacent.
    """
    height, width = fit_area(vision.area, picture.shape[0], picture.shape[1], vision.multiple)
    picture = resize(picture, (height, width), Image.Resampling.LANCZOS)
    picture = resize(picture, whole_patches(vision, height, width), Image.Resampling.BICUBIC)
    pixels = (picture / np.float32(255) - np.array(vision.mean, np.float32)) / np.array(
        vision.std, np.float32
    )
    side, merge = vision.patch, vision.merge
    rows, columns = pixels.shape[0] // side, pixels.shape[1] // side
    split = pixels.reshape(rows // merge, merge, side, columns // merge, merge, side, 3)
    split = split.transpose(0, 3, 1, 4, 6, 2, 5)[
        :, :, :, :, :, None
    ]  # (.., .., merge, merge, 3, 1, side, side)
    frames = np.repeat(split, vision.frames, axis=5)
    return np.ascontiguousarray(frames.reshape(rows * columns, -1), np.float32), (rows, columns)


def whole_patches(vision: VisionSettings, height: int, width: int) -> tuple[int, int]:
    """Return the nearest size in full merged patches within the model's limits of pixels."""
    unit = vision.patch * vision.merge
    rows, columns = round(height / unit) * unit, round(width / unit) * unit
    if rows * columns > vision.most_pixels:
        shrink = math.sqrt(height * width / vision.most_pixels)
        return tuple(max(unit, math.floor(side / shrink / unit) * unit) for side in (height, width))  # type: ignore
    if rows * columns < vision.least_pixels:
        grow = math.sqrt(vision.least_pixels / (height * width))
        return tuple(math.ceil(side * grow / unit) * unit for side in (height, width))  # type: ignore
    return rows, columns


def patch_places(vision: VisionSettings, grid: tuple[int, int]) -> NDArray[np.int64]:
    """Return (row, column) of each patch of a picture, in the order of `patchify`."""
    merge = vision.merge
    places = np.moveaxis(np.mgrid[: grid[0], : grid[1]], 0, -1)
    split = places.reshape(grid[0] // merge, merge, grid[1] // merge, merge, 2)
    return split.transpose(0, 2, 1, 3, 4).reshape(-1, 2)


def window_order(
    vision: VisionSettings, grids: Sequence[tuple[int, int]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the order of merged patches by window, and the window of each patch in that order."""
    side = vision.window // vision.patch // vision.merge
    keys = []
    for k, (rows, columns) in enumerate(grids):
        y, x = np.mgrid[: rows // vision.merge, : columns // vision.merge].reshape(2, -1)
        keys.append(np.stack([np.full_like(y, k), y // side, x // side], axis=1))
    number = np.unique(np.concatenate(keys), axis=0, return_inverse=True)[1]
    order = np.argsort(number.ravel(), kind="stable")
    return order, np.repeat(number.ravel()[order], vision.merge**2)


def _in_order(patches: NDArray, order: NDArray[np.int64], merge: int) -> NDArray:
    """Return the patches with their merged groups in the given order."""
    groups = patches.reshape(-1, merge**2, patches.shape[1])
    return np.ascontiguousarray(groups[order].reshape(patches.shape))
