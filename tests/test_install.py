"""The package as a user gets it: built, installed without torch beside it, and put to its main job."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
PARTS = {
    "dior_rt": "dior_rt",
    "kernels": "dior_rt/kernels",
    "export": "dior_rt/export",
    "training": "dior_rt/training",
}
MOST_MODEL_BYTES = 32e6


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of the tree, so that no earlier build lends it files."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for part in PARTS:
        shutil.copytree(ROOT / part, source / part, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "-o", out, source], check=True, capture_output=True
    )
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The commands of a fresh environment that holds the wheel and what it asks for, no more."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=True)
    commands = folder / ("Scripts" if os.name == "nt" else "bin")
    installing = run(commands / "python", "-m", "pip", "install", "--quiet", wheel, cwd=folder)
    assert installing.returncode == 0, installing.stderr
    return commands


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess:
    """A command that knows nothing of this repository or of the environment of the tests."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=600)


def test_the_wheel_holds_every_part_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {info.filename: info.file_size for info in archive.infolist()}
        metadata = archive.read(next(name for name in packed if name.endswith("METADATA"))).decode()
    assert {name.split("/")[0] for name in packed} - {"dior_rt"} == {
        f"{wheel.name.rsplit('-', 3)[0]}.dist-info"
    }
    for folder, package in PARTS.items():
        for file in (ROOT / folder).rglob("*"):
            if file.suffix in (".py", ".cl") and "__pycache__" not in file.parts:
                assert f"{package}/{file.relative_to(ROOT / folder).as_posix()}" in packed
    assert "dior_rt/py.typed" in packed
    for file in (ROOT / "dior_rt/desk/page").iterdir():
        assert f"dior_rt/desk/page/{file.name}" in packed
    assert any(name.endswith("licenses/LICENSE") for name in packed)
    assert "License-Expression: Apache-2.0" in metadata
    required = re.findall(r"^Requires-Dist: ([A-Za-z0-9_-]+)(?!.*extra ==)", metadata, re.MULTILINE)
    assert sorted(required) == ["OpenEXR", "numpy", "onnxruntime", "pillow", "typer"]


def test_the_model_is_in_the_wheel_and_small(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        model = [info for info in archive.infolist() if info.filename.startswith("dior_rt/bundles/mini/")]
        manifest = json.loads(archive.read("dior_rt/bundles/mini/manifest.json"))
    assert {info.filename.rpartition("/")[2] for info in model} == {"manifest.json", *manifest["files"]}
    assert sum(info.file_size for info in model) <= MOST_MODEL_BYTES


def test_the_main_job_in_a_fresh_environment_without_torch(installed: Path, tmp_path: Path) -> None:
    frozen = run(installed / "python", "-m", "pip", "list", "--format=freeze", cwd=tmp_path).stdout.lower()
    assert "dior" in frozen and not re.search(r"^(torch|onnx|diffusers|mitsuba)==", frozen, re.MULTILINE)

    # The README's own command, from a folder that holds the examples.
    command = re.search(r"^pip install \. && dior-rt (.*)$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert command
    (tmp_path / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    arguments = command[1].split()
    result = run(installed / "dior-rt", *arguments, "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    report = json.loads(result.stdout)

    with Image.open(ROOT / arguments[1]) as photo, Image.open(tmp_path / report["result"]) as relit:
        assert relit.size == photo.size and relit.mode == "RGB"
        before, after = (np.asarray(image, np.float32) for image in (photo, relit))
        assert json.loads(relit.text["Dior"]) == report["settings"]  # type: ignore[attr-defined]
    assert np.abs(after - before).mean() > 1
    assert after.std() > 10  # a picture, and not one colour


def test_the_kernels_run_on_numpy_out_of_the_box_and_name_the_extra(installed: Path, tmp_path: Path) -> None:
    code = "from dior_rt.kernels import open_ops; ops = open_ops('auto'); print(ops.name, ops.reason)"
    said = run(installed / "python", "-c", code, cwd=tmp_path).stdout
    assert said.startswith("numpy ") and "dior-rt[opencl]" in said
    result = run(installed / "dior-rt", "devices", "--json", cwd=tmp_path)
    assert result.returncode == 0 and "dior-rt[opencl]" in result.stdout


def test_no_part_is_importable_by_its_bare_name(installed: Path, tmp_path: Path) -> None:
    for name in ("kernels", "export", "training", "tests"):
        result = run(installed / "python", "-c", f"import {name}", cwd=tmp_path)
        assert "ModuleNotFoundError" in result.stderr
    assert run(installed / "python", "-c", "import dior_rt.kernels", cwd=tmp_path).returncode == 0


def test_a_command_without_its_extra_names_the_extra(installed: Path, tmp_path: Path) -> None:
    cases = {
        ("export", "checkpoint", "-o", "bundle"): "export",
        ("train", "render", "--out", "scenes"): "train",
        ("desk", "photo.jpg"): "desk",
    }
    for arguments, extra in cases.items():
        result = run(installed / "dior-rt", *arguments, cwd=tmp_path)
        assert result.returncode == 2
        sentence = f"dior-rt: `dior-rt {extra}` needs more packages: pip install 'dior-rt[{extra}]'.\n"
        assert result.stderr == sentence
    assert list(tmp_path.iterdir()) == []
    assert "render" in run(installed / "dior-rt", "train", "--help", cwd=tmp_path).stdout
