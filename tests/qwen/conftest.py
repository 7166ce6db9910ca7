"""A tiny Qwen-Image-Edit, as diffusers runs it and as the export makes a bundle of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

os.environ["HF_HUB_OFFLINE"] = "1"
pytest.importorskip("diffusers")
sys.path.insert(0, str(Path(__file__).parent))

import tiny_qwen
from agreement_qwen import AREA, RECIPE, VISION_AREA
from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as edit_plus

from dior_rt.bundle import read_bundle
from dior_rt.export.qwen.bundle import export_qwen
from dior_rt.families.qwen.model import Qwen

Make = Callable[..., Path]


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """Diffusers folders of the tiny model, by zero_cond_t."""
    root = tmp_path_factory.mktemp("diffusers")
    return {
        zero: tiny_qwen.save(tiny_qwen.pipeline(zero_cond_t=zero), root / f"zero_{zero}")
        for zero in (False, True)
    }


@pytest.fixture(scope="session")
def pipes() -> dict[bool, Any]:
    """Diffusers' pipelines of the same models."""
    return {zero: tiny_qwen.pipeline(zero_cond_t=zero) for zero in (False, True)}


@pytest.fixture(scope="session")
def make(folders: dict[bool, Path], tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Export a bundle of a tiny model, once for each set of options: make(zero, **fields of the recipe)."""
    made: dict[str, Path] = {}

    def export(zero: bool = True, **changes: Any) -> Path:
        recipe = replace(RECIPE, **changes)
        key = f"{zero} {recipe}"
        if key not in made:
            out = tmp_path_factory.mktemp("bundles") / "bundle"
            made[key] = export_qwen(folders[zero], out, recipe).folder
        return made[key]

    return export


@pytest.fixture(scope="session")
def qwens(make: Make) -> dict[bool, Qwen]:
    """The fp32 bundles with free steps, loaded."""
    return {zero: Qwen(read_bundle(make(zero)), "cpu") for zero in (False, True)}


@pytest.fixture(autouse=True)
def tiny_areas(monkeypatch: pytest.MonkeyPatch) -> None:
    """Diffusers' sizes, as small as the bundles'."""
    monkeypatch.setattr(edit_plus, "VAE_IMAGE_SIZE", AREA)
    monkeypatch.setattr(edit_plus, "CONDITION_IMAGE_SIZE", VISION_AREA)
