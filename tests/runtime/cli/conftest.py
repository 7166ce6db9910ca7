"""A folder with a photo and strokes, and the command line on the small bundle."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

HEIGHT, WIDTH = 40, 60


def make_photo(seed: int = 0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Image.Image:
    """Return a smooth picture of distinct colours."""
    y, x = np.mgrid[0 : 1 : size[0] * 1j, 0 : 1 : size[1] * 1j]
    base = np.random.default_rng(seed).uniform(0.2, 0.6, 3)
    photo = base + np.stack([0.3 * x, 0.3 * y, 0.3 * np.sin(9 * x * y)], -1)
    return Image.fromarray(np.round(np.clip(photo, 0, 1) * 255).astype(np.uint8))


def make_strokes(size: tuple[int, int] = (HEIGHT, WIDTH)) -> Image.Image:
    """Return a warm rectangle on a transparent layer."""
    strokes = np.zeros((*size, 4), np.uint8)
    strokes[size[0] // 8 : size[0] // 3, size[1] // 6 : size[1] // 2] = (255, 180, 100, 255)
    return Image.fromarray(strokes)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a working folder with photo.png and strokes.png."""
    monkeypatch.chdir(tmp_path)
    make_photo().save("photo.png")
    make_strokes().save("strokes.png")
    return tmp_path


@pytest.fixture
def model(mini_bundle: Path) -> list[str]:
    """Return the options that choose the small bundle and the kernels that start fastest."""
    return ["--bundle", str(mini_bundle), "--ops", "numpy"]


@pytest.fixture
def stdin(monkeypatch: pytest.MonkeyPatch):
    """Put bytes on standard input."""

    def put(data: bytes) -> None:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))

    return put
