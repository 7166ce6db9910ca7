"""What the README tells people to run, run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from dior_rt.images.strokes import read_strokes

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def block(language: str) -> str:
    """The README's one block of code in a language."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    return found


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A folder where the examples lie as in a clone."""
    (tmp_path / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    return tmp_path


def test_the_python_example_runs(clone: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-c", block("python")], cwd=clone, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    assert "4/4" in result.stdout
    with Image.open(clone / "relit.png") as relit, Image.open(ROOT / "examples/coffee.jpg") as photo:
        assert relit.size == photo.size


def test_the_json_example_is_strokes(tmp_path: Path) -> None:
    (tmp_path / "strokes.json").write_text(block("json"))
    strokes = read_strokes(tmp_path / "strokes.json", (400, 600))
    assert [stroke.intensity for stroke in strokes] == [3, 1]


@pytest.mark.parametrize(
    "strokes", sorted((ROOT / "examples").glob("*-strokes.*")), ids=lambda path: path.name
)
def test_the_examples_strokes_fit_their_photos(strokes: Path) -> None:
    with Image.open(strokes.with_name(strokes.name.split("-")[0] + ".jpg")) as photo:
        size = photo.height, photo.width
    assert len(read_strokes(strokes, size)) > 0


def test_every_local_link_leads_somewhere() -> None:
    for page in (ROOT / "README.md", ROOT / "examples" / "README.md"):
        for link in re.findall(r"\]\(([^)#]+)", page.read_text()):
            assert "://" in link or (page.parent / link).exists(), link
