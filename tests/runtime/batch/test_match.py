"""Matching photos with strokes."""

from __future__ import annotations

from pathlib import Path

import pytest

from dior_rt.batch.match import find_strokes, is_drawing
from dior_rt.errors import InputError


def match(photo: str, strokes: str | None = None, place: str | None = None) -> str:
    path = Path(photo)
    found = find_strokes(path, Path(place or path.name), Path(strokes) if strokes else None)
    return found.as_posix()


@pytest.mark.parametrize(
    "drawing", ["a.json", "a.npy", "a.dior", "a-light.png", "a-strokes.exr", "a-light.json"]
)
def test_strokes_beside_the_photo(make, drawing: str) -> None:
    make("in/a.jpg", f"in/{drawing}", "in/b.json")
    assert match("in/a.jpg") == f"in/{drawing}"


def test_another_photo_of_the_same_name_is_no_drawing(make) -> None:
    make("a.jpg", "a.png", "a.exr")
    with pytest.raises(InputError, match="no strokes"):
        match("a.jpg")


def test_a_folder_of_strokes_is_laid_out_like_the_photos_or_flat(make) -> None:
    make("in/sub/a.jpg", "in/b.jpg", "s/sub/a.png", "s/a.json", "s/b.png")
    assert match("in/sub/a.jpg", "s", "sub/a.jpg") == "s/sub/a.png"
    assert match("in/b.jpg", "s", "b.jpg") == "s/b.png"
    make("in/deep/a.jpg")
    assert match("in/deep/a.jpg", "s", "deep/a.jpg") == "s/a.json"


def test_a_photo_in_the_folder_of_strokes_is_not_its_own_drawing(make) -> None:
    make("in/a.png", "in/a-light.png")
    assert match("in/a.png", "in") == "in/a-light.png"


def test_one_drawing_for_all(make) -> None:
    make("a.jpg", "one.json")
    assert match("a.jpg", "one.json") == "one.json"


def test_two_drawings_are_refused(make) -> None:
    make("a.jpg", "a.json", "a-light.png")
    with pytest.raises(InputError, match="two drawings"):
        match("a.jpg")


def test_names_that_say_drawing() -> None:
    for name, drawing in (("a.json", True), ("a-light.jpg", True), ("light.jpg", False), ("a.exr", False)):
        assert is_drawing(Path(name)) is drawing
