"""Strokes and Lumi maps from files: expected colours, every kind, sizes, and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.images.exr import read_exr, write_exr
from dior_rt.images.strokes import read_lumi, read_strokes, write_lumi, write_strokes
from dior_rt.kernels import NumpyOps, Stroke, Strokes
from dior_rt.kernels.color import srgb_to_linear

SIZE = (40, 60)  # the photo's rows and columns


def lumi(height: int = 12, width: int = 18) -> np.ndarray:
    """Return a smooth map with light above display white."""
    y, x = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    return np.stack([3 * x, y, 0.2 + 0 * x], -1).astype(np.float32)


def drawn(raster: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the grid of a raster that the kernels see: (light, mask)."""
    grid = NumpyOps().reduce_strokes(raster[..., :3], raster[..., 3], raster.shape[:2])
    return grid.light, grid.mask


# Rasters


def test_rgba_alpha_says_what_is_specified(tmp_path: Path) -> None:
    rgba = np.zeros((*SIZE, 4), np.uint8)
    rgba[5:9, 10:20] = (255, 128, 0, 255)
    rgba[20:22, 3:5] = (0, 0, 0, 255)  # drawn darkness is specified
    Image.fromarray(rgba).save(tmp_path / "s.png")
    light, mask = drawn(read_strokes(tmp_path / "s.png", SIZE))
    np.testing.assert_array_equal(mask, rgba[..., 3] / 255)
    np.testing.assert_allclose(light[6, 15], [1, srgb_to_linear(128 / 255), 0], atol=1e-6)
    assert (light[20, 3] == 0).all() and mask[20, 3] == 1


def test_a_16_bit_rgba_is_read_in_full(tmp_path: Path) -> None:
    import png

    rgba = np.zeros((*SIZE, 4), np.uint16)
    rgba[1, 2] = (12345, 54321, 1, 65535)
    with (tmp_path / "s.png").open("wb") as file:
        png.Writer(SIZE[1], SIZE[0], bitdepth=16, greyscale=False, alpha=True).write(
            file, rgba.reshape(SIZE[0], -1)
        )
    raster = read_strokes(tmp_path / "s.png", SIZE)
    assert raster.dtype == np.uint16
    np.testing.assert_array_equal(raster, rgba)


def test_rgb_is_dense_and_the_key_frees_black(tmp_path: Path) -> None:
    rgb = np.zeros((*SIZE, 3), np.uint8)
    rgb[3, 4] = (0, 0, 1)
    rgb[8, 9] = (200, 100, 50)
    Image.fromarray(rgb).save(tmp_path / "s.png")
    assert (read_strokes(tmp_path / "s.png", SIZE)[..., 3] == 255).all()
    mask = read_strokes(tmp_path / "s.png", SIZE, key="black")[..., 3]
    assert np.argwhere(mask).tolist() == [[3, 4], [8, 9]] and set(mask.flat) == {0, 255}


def test_the_key_narrows_alpha(tmp_path: Path) -> None:
    rgba = np.zeros((*SIZE, 4), np.uint8)
    rgba[0, 0], rgba[0, 1], rgba[0, 2] = (0, 0, 0, 255), (9, 0, 0, 77), (9, 0, 0, 0)
    Image.fromarray(rgba).save(tmp_path / "s.png")
    assert read_strokes(tmp_path / "s.png", SIZE, key="black")[0, :3, 3].tolist() == [0, 77, 0]


def test_strokes_lie_over_the_photo_as_it_is_seen(tmp_path: Path) -> None:
    rgba = np.zeros((*SIZE, 4), np.uint8)
    rgba[0, :5] = 255
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.fromarray(rgba).save(tmp_path / "s.png", exif=exif.tobytes())
    assert read_strokes(tmp_path / "s.png", SIZE)[-1, -5:, 3].all()


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
def test_npy_maps_are_linear_light(tmp_path: Path, dtype: Any) -> None:
    np.save(tmp_path / "m.npy", lumi().astype(dtype))
    raster = read_strokes(tmp_path / "m.npy", SIZE)
    assert raster.dtype == np.float32 and (raster[..., 3] == 1).all()
    np.testing.assert_allclose(raster[..., :3], lumi(), rtol=1e-3)

    sparse = np.dstack([lumi(), np.eye(12, 18)]).astype(dtype)
    sparse[3, 4, :3] = np.nan  # unspecified, so nobody looks
    np.save(tmp_path / "m.npy", sparse)
    np.testing.assert_array_equal(read_strokes(tmp_path / "m.npy", SIZE)[..., 3], np.eye(12, 18))


def test_exr_maps(tmp_path: Path) -> None:
    import OpenEXR

    write_exr(tmp_path / "m.exr", lumi())
    np.testing.assert_array_equal(read_strokes(tmp_path / "m.exr", SIZE)[..., :3], lumi())

    alpha = np.linspace(0, 1, 12 * 18, dtype=np.float32).reshape(12, 18)
    multiplied = np.dstack([lumi() * alpha[..., None], alpha]).astype(np.float16)
    OpenEXR.File({}, {"RGBA": multiplied}).write(str(tmp_path / "a.exr"))
    raster = read_strokes(tmp_path / "a.exr", SIZE)
    np.testing.assert_allclose(raster[..., 3], alpha, atol=1e-3)
    np.testing.assert_allclose(raster[1:, :, :3], lumi()[1:], rtol=5e-3)

    # A render of a part of the picture: its data window is smaller than its display window.
    window = {"dataWindow": ((2, 1), (6, 3)), "displayWindow": ((0, 0), (8, 5))}
    header = {k: tuple(np.array(corner, np.int32) for corner in v) for k, v in window.items()}
    OpenEXR.File(header, {"RGB": np.full((3, 5, 3), 2.0, np.float16)}).write(str(tmp_path / "w.exr"))
    placed = np.zeros((6, 9, 3))
    placed[1:4, 2:7] = 2
    np.testing.assert_array_equal(read_exr(tmp_path / "w.exr", "map"), placed)


@pytest.mark.parametrize(
    ("suffix", "wrong"),
    [(".npy", np.nan), (".npy", np.inf), (".npy", -0.25), (".exr", np.nan), (".exr", np.inf)],
)
def test_light_that_cannot_be_is_refused(tmp_path: Path, suffix: str, wrong: float) -> None:
    values = lumi()
    values[4, 5, 1] = wrong
    path = tmp_path / f"m{suffix}"
    write_lumi(path, values, {})
    for read in (lambda: read_strokes(path, SIZE), lambda: read_lumi(path)):
        with pytest.raises(InputError, match="finite and not negative"):
            read()


def test_arrays_that_are_no_maps_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    path = tmp_path / "m.npy"
    cases = {
        "rows, columns": np.zeros((4, 4), np.float32),
        "3 or 4": np.zeros((4, 4, 2), np.float32),
        "not uint8": np.zeros((4, 4, 3), np.uint8),
        "mask": np.full((4, 4, 4), 1.5, np.float32),
        "not object|pickle|Object|object": np.array([[{}]], dtype=object),
    }
    for words, array in cases.items():
        np.save(path, array, allow_pickle=True)
        with pytest.raises(InputError, match=words):
            read_strokes(path, SIZE)
    np.save(path, np.float64(1e300) * np.ones((4, 4, 3)))
    with pytest.raises(InputError, match="finite"):
        read_strokes(path, SIZE)

    # A header that promises terabytes.
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000, 3), }"
    header += b" " * (118 - len(header) - 1) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(100))
    with pytest.raises(InputError):
        read_strokes(path, SIZE)

    write_exr(tmp_path / "m.exr", lumi())
    whole = (tmp_path / "m.exr").read_bytes()
    for length in (0, 3, 40, len(whole) // 2, len(whole) - 9):
        (tmp_path / "m.exr").write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"Cannot read the strokes .*m\.exr"):
            read_strokes(tmp_path / "m.exr", SIZE)
    said = capfd.readouterr()
    assert said.err == "" and said.out == ""  # the library's own words stay inside


def test_damaged_exr_bytes_never_escape_as_another_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    path = tmp_path / "m.exr"
    write_exr(path, lumi())
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    refused = 0
    for i in range(300):
        harmed = whole.copy()
        harmed[rng.integers(0, 330 if i % 2 else len(whole), 4)] = rng.integers(0, 256, 4)
        path.write_bytes(harmed.tobytes())
        try:
            read_exr(path, "map")
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 50


def test_an_exr_without_colour_is_refused(tmp_path: Path) -> None:
    import OpenEXR

    OpenEXR.File({}, {"Y": np.ones((4, 4), np.float32)}).write(str(tmp_path / "y.exr"))
    with pytest.raises(InputError, match="no channels R, G and B"):
        read_strokes(tmp_path / "y.exr", SIZE)


# JSON


def read_json(tmp_path: Path, document: Any, size: tuple[int, int] = SIZE) -> list[Stroke]:
    path = tmp_path / "s.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return read_strokes(path, size)


def test_json_strokes(tmp_path: Path) -> None:
    line = {"points": [[1, 2], [30.5, 4]], "width": 6}
    full = {**line, "color": "#ff8000", "intensity": 250, "softness": 0.5}
    linear = {"points": [[-5, 99]], "width": 0.5, "color": [2, 0.25, 0]}
    plain, coloured, dot = read_json(tmp_path, [line, full, linear])
    assert plain == Stroke(((1, 2), (30.5, 4)), 6.0)
    assert plain.light == (1, 1, 1)
    assert coloured.light == pytest.approx([250, 250 * float(srgb_to_linear(128 / 255)), 0])
    assert coloured.softness == 0.5
    assert dot == Stroke(((-5, 99),), 0.5, (2, 0.25, 0))
    assert read_json(tmp_path, {"strokes": [line]}) == [plain]
    assert read_json(tmp_path, []) == []


def test_json_coordinates_follow_the_drawings_size(tmp_path: Path) -> None:
    drawing = {"size": [600, 400], "strokes": [{"points": [[300, 100]], "width": 20}]}
    assert read_json(tmp_path, drawing) == [Stroke(((30, 10),), 2.0)]
    # Drawn over a preview whose height was rounded: 1000 x 667 for 3000 x 2000.
    drawing["size"] = [1000, 667]
    (stroke,) = read_json(tmp_path, drawing, (2000, 3000))
    assert stroke.points[0] == pytest.approx((900, 299.85), abs=0.1)
    drawing["size"] = [400, 600]
    with pytest.raises(InputError, match=r"400 x 600 .* 60 x 40"):
        read_json(tmp_path, drawing)


STROKE = {"points": [[1, 2]], "width": 3}
WRONG_JSON: list[tuple[Any, str]] = [
    ("{", "Cannot read the strokes"),
    ("", "Cannot read the strokes"),
    ("[NaN]", "NaN"),
    ('[{"points": [[1, 2]], "width": 3, "width": 4}]', "twice"),
    ("[" * 100_000, "nested"),
    (3, "list of strokes"),
    ({"size": [60, 40]}, "'strokes' is missing"),
    ({"strokes": [STROKE], "color": "red"}, "'color' is unknown"),
    ({"size": [0, 0], "strokes": []}, "size"),
    ({"size": "60x40", "strokes": []}, "size"),
    ([STROKE, 4], "stroke 2: it must be an object"),
    ([{"points": [[1, 2]]}], "'width' is missing"),
    ([{**STROKE, "colour": "#ffffff"}], "stroke 1: the key 'colour' is unknown"),
    ([{**STROKE, "points": []}], "at least one point"),
    ([{**STROKE, "points": [[1, 2, 3]]}], "each point"),
    ([{**STROKE, "points": [["1", 2]]}], "numbers"),
    ([{**STROKE, "points": [[True, 2]]}], "numbers"),
    ('[{"points": [[1e999, 2]], "width": 3}]', "within"),
    ([{**STROKE, "width": 0}], "width"),
    ([{**STROKE, "width": -3}], "width"),
    ([{**STROKE, "color": "red"}], "#rrggbb"),
    ([{**STROKE, "color": [1, 2]}], "3 numbers"),
    ([{**STROKE, "color": [1, -2, 0]}], ">= 0"),
    ([{**STROKE, "intensity": -1}], "intensity"),
    ([{**STROKE, "intensity": 10**400}], "stroke 1"),
    ([{**STROKE, "softness": 2}], "softness"),
    ([{**STROKE, "softness": None}], "softness"),
]


@pytest.mark.parametrize(("document", "words"), WRONG_JSON, ids=lambda value: str(value)[:40])
def test_wrong_json_is_refused_with_its_place(tmp_path: Path, document: Any, words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_json(tmp_path, document)
    assert words in str(caught.value) and "\n" not in str(caught.value)


# Writing


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_lumi_maps_come_back_bit_for_bit(tmp_path: Path, suffix: str) -> None:
    write_lumi(tmp_path / f"m{suffix}", lumi(), {})
    np.testing.assert_array_equal(read_lumi(tmp_path / f"m{suffix}"), lumi())
    assert [p.name for p in tmp_path.iterdir()] == [f"m{suffix}"]


def test_a_picture_of_a_lumi_map_is_clipped_at_white(tmp_path: Path) -> None:
    write_lumi(tmp_path / "m.png", lumi(), {})
    np.testing.assert_allclose(read_lumi(tmp_path / "m.png"), np.minimum(lumi(), 1), atol=0.005)


def test_strokes_come_back(tmp_path: Path) -> None:
    strokes = NumpyOps().sparsify(lumi(), "strokes", seed=3)
    write_strokes(tmp_path / "s.npy", strokes, {})
    raster = read_strokes(tmp_path / "s.npy", SIZE)
    np.testing.assert_array_equal(raster, np.dstack([strokes.light, strokes.mask]))
    with pytest.raises(InputError, match="unspecified"):
        read_lumi(tmp_path / "s.npy")

    faint = Strokes(strokes.light / 3, strokes.mask)
    write_strokes(tmp_path / "s.png", faint, {})
    light, mask = drawn(read_strokes(tmp_path / "s.png", SIZE))
    np.testing.assert_array_equal(mask, strokes.mask)
    np.testing.assert_allclose(light[mask > 0], faint.light[mask > 0], atol=0.005)

    write_strokes(tmp_path / "s.exr", strokes, {})
    np.testing.assert_array_equal(read_strokes(tmp_path / "s.exr", SIZE), raster)
    with pytest.raises(InputError, match=r"\.png, \.npy or \.exr"):
        write_strokes(tmp_path / "s.jpg", strokes, {})
