"""Run the examples of the README and the documentation, and follow their links."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from dior_rt.images.strokes import read_strokes

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.md")])


def block(page: str, language: str) -> str:
    """Return the page's only block of code in a language."""
    text = (ROOT / page).read_text()
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return found


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A folder where the examples lie as in a clone."""
    (tmp_path / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    return tmp_path


def test_the_python_example_runs(clone: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-c", block("docs/python.md", "python")],
        cwd=clone,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    assert "4/4" in result.stdout
    with Image.open(clone / "relit.png") as relit, Image.open(ROOT / "examples/coffee.jpg") as photo:
        assert relit.size == photo.size


@pytest.mark.parametrize("page", ["README.md", "docs/guide.md"])
def test_the_json_example_is_strokes(page: str, tmp_path: Path) -> None:
    (tmp_path / "strokes.json").write_text(block(page, "json"))
    strokes = read_strokes(tmp_path / "strokes.json", (400, 600))
    assert [stroke.intensity for stroke in strokes] == [3, 1]


@pytest.mark.parametrize(
    "strokes", sorted((ROOT / "examples").glob("*-strokes.*")), ids=lambda path: path.name
)
def test_the_examples_strokes_fit_their_photos(strokes: Path) -> None:
    with Image.open(strokes.with_name(strokes.name.split("-")[0] + ".jpg")) as photo:
        size = photo.height, photo.width
    assert len(read_strokes(strokes, size)) > 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_local_link_leads_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def test_every_page_is_in_the_index() -> None:
    """The index of docs/ and of docs/experiments/ lists every page beside it."""
    for index in (ROOT / "docs/README.md", ROOT / "docs/experiments/README.md"):
        listed = set(re.findall(r"\]\(([^)#]+)\)", index.read_text()))
        for page in index.parent.glob("*.md"):
            assert page == index or page.name in listed, f"{index.relative_to(ROOT)} lacks {page.name}"


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
