"""Standard input and output in place of files, and results that are not overwritten."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.cli import run
from dior_rt.cli.pipes import suffix_of

STROKES = [{"points": [[10, 10], [40, 20]], "width": 9, "color": [0.5, 0.25, 0.125]}]


def pixels(source: str | bytes) -> np.ndarray:
    with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as image:
        return np.asarray(image)


@pytest.fixture
def expected(folder: Path, model: list[str]) -> np.ndarray:
    assert run(["relight", "photo.png", "strokes.png", "-o", "expected.png", *model]) == 0
    return pixels("expected.png")


def test_a_photo_from_standard_input_goes_to_standard_output(expected, model, stdin, capfdbinary) -> None:
    stdin(Path("photo.png").read_bytes())
    assert run(["relight", "-", "strokes.png", *model]) == 0
    said = capfdbinary.readouterr()
    np.testing.assert_array_equal(pixels(said.out), expected)
    assert said.err == b""


def test_strokes_of_every_kind_come_from_standard_input(folder, model, stdin) -> None:
    Path("s.json").write_text(json.dumps(STROKES))
    np.save("s.npy", np.full((40, 60, 3), 0.5, np.float32))
    for name in ("strokes.png", "s.json", "s.npy"):
        assert run(["relight", "photo.png", name, "-o", f"{name}-a.png", *model]) == 0
        stdin(Path(name).read_bytes())
        assert run(["relight", "photo.png", "-", "-o", f"{name}-b.png", *model]) == 0
        np.testing.assert_array_equal(pixels(f"{name}-a.png"), pixels(f"{name}-b.png"))


def test_a_whole_pipe_of_processes(expected, model) -> None:
    result = subprocess.run(
        [
            sys.executable,
            "-m",
            "dior_rt",
            "relight",
            "-",
            "strokes.png",
            "-o",
            "-",
            "--format",
            "tif",
            *model,
        ],
        input=Path("photo.png").read_bytes(),
        capture_output=True,
        check=True,
    )
    with Image.open(io.BytesIO(result.stdout)) as image:
        assert image.format == "TIFF"
        np.testing.assert_array_equal(np.asarray(image), expected)


def test_the_format_completes_the_name(folder, model) -> None:
    assert run(["relight", "photo.png", "strokes.png", "--format", "webp", *model]) == 0
    assert run(["relight", "photo.png", "strokes.png", "--format", "tif", "-o", "plain", *model]) == 0
    for name, kind in (("photo-relit.webp", "WEBP"), ("plain.tif", "TIFF")):
        with Image.open(name) as image:
            assert image.format == kind


def test_a_result_that_is_there_is_kept(expected, model, capfd) -> None:
    before = Path("expected.png").read_bytes()
    call = ["relight", "photo.png", "strokes.png", "-o", "expected.png", "--seed", "7", *model]
    assert run(call) == 2
    assert "--overwrite" in capfd.readouterr().err and Path("expected.png").read_bytes() == before
    assert run([*call, "--overwrite"]) == 0
    assert Path("expected.png").read_bytes() != before


def test_quiet_leaves_out_notices(folder, model, capfd) -> None:
    Image.new("RGBA", (60, 40)).save("nothing.png")
    call = ["relight", "photo.png", "nothing.png", "--overwrite", *model]
    assert run(call) == 0 and "nothing" in capfd.readouterr().err
    assert run([*call, "--quiet"]) == 0 and capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-", "-"], "Only one"),
        (["-", "strokes.png"], "photo from standard input: it is empty"),
        (["photo.png", "-"], "strokes from standard input"),
        (["photo.png", "strokes.png", "-o", "-", "--json"], "--json"),
        (["photo.png", "strokes.png", "-o", "x.png", "--format", "tif"], "two kinds"),
        (["photo.png", "strokes.png", "--format", "bmp"], "--format"),
    ],
)
def test_what_cannot_be_is_one_sentence(folder, model, stdin, capfdbinary, arguments, words) -> None:
    stdin(b"")
    assert run(["relight", *arguments, *model]) == 2
    said = capfdbinary.readouterr()
    assert words in said.err.decode() and said.err.count(b"\n") == 1 and said.out == b""
    assert sorted(path.name for path in folder.iterdir()) == ["photo.png", "strokes.png"]


def test_kinds_are_told_by_their_first_bytes() -> None:
    assert suffix_of(b"\x93NUMPY\x01") == ".npy"
    assert suffix_of(b"\x76\x2f\x31\x01") == ".exr"
    assert suffix_of(' \n[{"points"'.encode("utf-16")) == ".json"
    assert suffix_of(b"\x89PNG") == ".png"
