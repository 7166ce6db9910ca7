"""Finding photos."""

from __future__ import annotations

from pathlib import Path

import pytest

from dior_rt.batch.find import find_photos, read_names
from dior_rt.errors import InputError


def names(*inputs: str, besides: tuple[str, ...] = ()) -> list[str]:
    return [photo.path.as_posix() for photo in find_photos(inputs, [Path(path) for path in besides])]


def test_a_folder_gives_its_photos_and_nothing_else(make) -> None:
    make("in/b.JPG", "in/a.png", "in/sub/c.tif", "in/.hidden.png", "in/.git/d.png", "in/notes.txt")
    make("in/a.json", "in/a-light.png", "in/b-strokes.exr", "in/a-relit.png")
    assert names("in") == ["in/a.png", "in/b.JPG", "in/sub/c.tif"]
    places = [photo.place.as_posix() for photo in find_photos(["in"])]
    assert places == ["a.png", "b.JPG", "sub/c.tif"]


def test_results_inside_the_folder_are_left_out(make) -> None:
    make("in/a.png", "in/out/a.png")
    assert names("in", besides=("in/out",)) == ["in/a.png"]


def test_a_file_that_is_named_is_taken_whatever_its_name(make) -> None:
    make("a-relit.png", "photo")
    assert names("a-relit.png", "photo") == ["a-relit.png", "photo"]


def test_patterns_keep_the_folders_below_their_fixed_part(make) -> None:
    make("x/day1/a.jpg", "x/day2/a.jpg", "x/day2/b.png")
    found = find_photos(["x/day*/*.jpg"])
    assert [photo.place.as_posix() for photo in found] == ["day1/a.jpg", "day2/a.jpg"]
    assert names("x/**/*.png") == ["x/day2/b.png"]


def test_a_photo_that_is_named_twice_is_found_once(make) -> None:
    make("in/a.png")
    Path("link.png").symlink_to("in/a.png")
    assert names("in", "in/a.png", "./in/../in/a.png", "link.png") == ["in/a.png"]


def test_what_is_not_there_is_said(make) -> None:
    make("a.png")
    with pytest.raises(InputError, match=r"none\.png is not there"):
        names("none.png")
    with pytest.raises(InputError, match="No file fits"):
        names("*.jpg")


def test_lists_have_lines_or_nul(make) -> None:
    assert read_names(b"a.png\nb c.png\r\n\n") == ["a.png", "b c.png"]
    assert read_names(b"a.png\0with\nline.png\0") == ["a.png", "with\nline.png"]
    with pytest.raises(InputError, match="UTF-8"):
        read_names(b"\xff\xfe.png\n")
