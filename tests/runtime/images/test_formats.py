"""Formats beyond Pillow's: HEIC, JPEG XL, camera raw, EXR and flat Photoshop documents; bits and quality."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.images.encoding import Encoding
from dior_rt.images.exr import read_exr, read_exr_picture, write_exr
from dior_rt.images.photo import Photo, check_output, read_photo, write_photo
from dior_rt.images.primaries import DISPLAY_P3, SRGB_TAG, make_profile
from dior_rt.images.readers import default_form, find_reader
from dior_rt.images.sidecar import sidecar_path, write_sidecar

ROOT = Path(__file__).resolve().parents[3]
SIZE = (48, 64)


def ramp(dtype: type = np.uint16) -> np.ndarray:
    """Return (H, W, 3): a smooth picture that uses all codes."""
    y, x = np.mgrid[0 : 1 : SIZE[0] * 1j, 0 : 1 : SIZE[1] * 1j]
    top = np.iinfo(dtype).max
    return np.round(np.stack([x, y, (x + y) / 2], -1) * top).astype(dtype)


def write_heic(path: Path, samples: np.ndarray, bits: int = 8, **more: object) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.options.SAVE_HDR_TO_12_BIT = bits == 12
    mode = "RGB" if samples.dtype == np.uint8 else "RGB;16"
    heif.from_bytes(mode, samples.shape[1::-1], samples.tobytes()).save(path, quality=-1, chroma=444, **more)


def write_psd(path: Path, samples: np.ndarray) -> None:
    """Write a flat RGB document without layers, uncompressed."""
    height, width, _ = samples.shape
    header = b"8BPS" + struct.pack(">H6xHIIHH", 1, 3, height, width, 8, 3)
    path.write_bytes(header + struct.pack(">III", 0, 0, 0) + b"\0\0" + samples.transpose(2, 0, 1).tobytes())


def write_dng(path: Path, mosaic: np.ndarray, neutral: tuple[int, int, int] = (1, 1, 1)) -> None:
    """Write a camera's RGGB mosaic, linear, 16 bits. neutral: the camera's counts of grey, times 2."""
    tifffile = pytest.importorskip("tifffile")
    matrix = [32406, 10000, -15372, 10000, -4986, 10000, -9689, 10000, 18758, 10000, 415, 10000]
    matrix += [557, 10000, -2040, 10000, 10570, 10000]  # XYZ -> linear sRGB: a camera with those primaries
    tags = [
        (33421, 3, 2, (2, 2), True),  # the mosaic's period
        (33422, 1, 4, (0, 1, 1, 2), True),  # red, green, green, blue
        (50706, 1, 4, (1, 4, 0, 0), True),  # DNG 1.4
        (50708, 2, 5, "Test", True),
        (50714, 3, 1, 0, True),  # black
        (50717, 3, 1, 65535, True),  # white
        (50721, 10, 9, matrix, True),
        (50728, 5, 3, [v for n in neutral for v in (n, 2)], True),
        (50778, 3, 1, 21, True),  # D65
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)


def mosaic(colours: np.ndarray) -> np.ndarray:
    """Return the picture (H, W, 3) as an RGGB sensor records it."""
    raw = colours[..., 1].copy()
    raw[::2, ::2], raw[1::2, 1::2] = colours[::2, ::2, 0], colours[1::2, 1::2, 2]
    return raw


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_heic_keeps_its_bits(tmp_path: Path, bits: int) -> None:
    wanted = ramp(np.uint8 if bits == 8 else np.uint16)
    write_heic(tmp_path / "a.heic", wanted, bits)
    photo = read_photo(tmp_path / "a.heic")
    assert photo.bits == (8 if bits == 8 else 16) and photo.size == SIZE
    step = {8: 2, 10: 3 * 64, 12: 3 * 16}[bits]  # YCbCr of the coded depth, rounded twice
    assert np.abs(photo.pixels.astype(int) - wanted).max() <= step


def test_heic_keeps_profile_and_exif_and_is_not_turned_twice(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Camera", 6
    profile = make_profile(DISPLAY_P3, SRGB_TAG)
    pytest.importorskip("pillow_heif").register_heif_opener()
    image = Image.fromarray(ramp(np.uint8))
    image.save(tmp_path / "a.heic", quality=-1, exif=exif.tobytes(), icc_profile=profile)
    with Image.open(tmp_path / "a.heic") as opened:
        upright = opened.size
    photo = read_photo(tmp_path / "a.heic")
    assert photo.size == upright[::-1] and photo.icc == profile and b"Camera" in photo.exif


def test_a_photo_without_its_extra_names_the_extra(tmp_path: Path, monkeypatch) -> None:
    heads = {
        "a.heic": (b"\0\0\0\x18ftypheic" + bytes(50), "heic", "pillow_heif", "heif"),
        "a.jxl": (b"\xff\x0a" + bytes(50), "jxl", "OpenImageIO", "jxl"),
        "a.cr2": (b"II*\0\x10\0\0\0CR\2\0" + bytes(50), "raw", "rawpy", "raw"),
    }
    for name, (head, extra, library, module) in heads.items():
        monkeypatch.setitem(sys.modules, library, None)
        monkeypatch.delitem(sys.modules, f"dior_rt.images.{module}", raising=False)
        (tmp_path / name).write_bytes(head)
        with pytest.raises(InputError, match=rf"{name}.*dior-rt\[{extra}\]"):
            read_photo(tmp_path / name)


@pytest.mark.parametrize("name", ["a.heic", "a.jxl", "a.dng", "a.exr"])
def test_damaged_files_are_one_sentence(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    make = {
        "a.heic": lambda: write_heic(path, ramp(np.uint8)),
        "a.jxl": lambda: (pytest.importorskip("OpenImageIO"), write_photo(path, Photo(ramp()), {})),
        "a.dng": lambda: (pytest.importorskip("rawpy"), write_dng(path, mosaic(ramp()))),
        "a.exr": lambda: write_exr(path, ramp().astype(np.float32)),
    }
    make[name]()
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for cut in (20, 64, 100, len(data) // 2, *rng.integers(8, len(data), 20)):
        broken = bytearray(data[: int(cut)] if cut <= len(data) // 2 else data)
        broken[int(cut) % len(broken)] ^= 0xFF
        path.write_bytes(bytes(broken))
        try:
            read_photo(path)
        except InputError as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
    assert refused


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_jpeg_xl_keeps_pixels_profile_and_transparency(tmp_path: Path, dtype: type) -> None:
    pytest.importorskip("OpenImageIO")
    profile = make_profile(DISPLAY_P3, SRGB_TAG)
    alpha = ramp(dtype)[..., 0].copy()
    photo = Photo(ramp(dtype), alpha, icc=profile)
    write_photo(tmp_path / "a.jxl", photo, {})
    again = read_photo(tmp_path / "a.jxl")
    np.testing.assert_array_equal(again.pixels, photo.pixels)
    np.testing.assert_array_equal(again.alpha, alpha)
    assert again.icc == profile
    write_photo(tmp_path / "b.jxl", Photo(ramp(dtype)), {}, Encoding(quality=60))
    assert np.abs(read_photo(tmp_path / "b.jxl").pixels.astype(float) - ramp(dtype)).max() > 0


def test_camera_raw_is_developed_in_linear_light_and_its_white_balance(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    levels = np.linspace(0.02, 0.45, SIZE[1])
    grey = np.broadcast_to(levels[None, :, None], (*SIZE, 3))
    warm = grey * (0.5, 1, 1)  # the sensor counts half as much red
    write_dng(tmp_path / "a.dng", mosaic(np.round(warm * 65535).astype(np.uint16)), (1, 2, 2))
    photo = read_photo(tmp_path / "a.dng")
    assert photo.bits == 16 and photo.notices and photo.icc
    inner = photo.pixels[8:-8, 8:-8].astype(float) / 65535
    assert np.abs(inner - inner[..., 1:2]).max() < 0.01  # grey again
    linear = np.where(inner <= 0.04045, inner / 12.92, ((inner + 0.055) / 1.055) ** 2.4)[..., 1]
    ratio = linear.mean(0) / levels[8:-8]
    assert ratio.std() / ratio.mean() < 0.02  # twice the count is twice the light
    write_photo(tmp_path / "a.tif", photo, {})
    np.testing.assert_allclose(read_photo(tmp_path / "a.tif").pixels, photo.pixels, atol=2)
    assert default_form(tmp_path / "a.dng") == "tif"


def test_exr_keeps_light_above_white(tmp_path: Path) -> None:
    light = np.linspace(0, 40, SIZE[0] * SIZE[1] * 3, dtype=np.float32).reshape(*SIZE, 3)
    write_exr(tmp_path / "a.exr", light)
    photo = read_photo(tmp_path / "a.exr")
    assert photo.bits == 32 and photo.pixels.max() > 1 and photo.notices == ()
    write_photo(tmp_path / "b.exr", photo, {"seed": 7})
    np.testing.assert_allclose(read_exr(tmp_path / "b.exr", "photo"), light, rtol=1e-5, atol=1e-6)
    write_photo(tmp_path / "c.exr", photo, {}, Encoding(bits=16))
    np.testing.assert_allclose(read_exr(tmp_path / "c.exr", "photo"), light, rtol=1e-3, atol=1e-4)
    (notice,) = write_photo(tmp_path / "a.png", photo, {})
    assert "display white" in notice and read_photo(tmp_path / "a.png").bits == 16


def test_exr_with_strange_light(tmp_path: Path) -> None:
    light = np.full((*SIZE, 4), 0.5, np.float32)
    light[0, 0] = (np.nan, 1, 1, 1)
    light[0, 1] = (-1, 1e9, 1, 1)
    light[..., 3] = 0.25
    write_exr(tmp_path / "a.exr", light)
    photo = read_photo(tmp_path / "a.exr")
    assert np.isfinite(photo.pixels).all() and photo.pixels.min() >= 0
    assert (
        "1 of its pixels are not finite" in photo.notices[0]
        and "1 of its pixels are below" in photo.notices[1]
    )
    write_photo(tmp_path / "b.exr", photo, {})
    np.testing.assert_allclose(read_exr_picture(tmp_path / "b.exr", "photo").pixels[1:], light[1:], rtol=1e-5)


def test_exr_of_an_eight_bit_photo_is_its_light(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.exr", Photo(np.full((*SIZE, 3), 188, np.uint8)), {})
    np.testing.assert_allclose(read_exr(tmp_path / "a.exr", "photo"), 0.5, atol=0.005)
    photo = Photo(ramp(np.uint8), icc=make_profile(DISPLAY_P3, SRGB_TAG))
    with pytest.raises(InputError, match="colour profile"):
        check_output(tmp_path / "b.exr", photo)


def test_a_flat_photoshop_document(tmp_path: Path) -> None:
    write_psd(tmp_path / "a.psd", ramp(np.uint8))
    photo = read_photo(tmp_path / "a.psd")
    np.testing.assert_array_equal(photo.pixels, ramp(np.uint8))
    assert "without layers" in photo.notices[0]


def test_an_hdr_gain_map_is_noticed(tmp_path: Path) -> None:
    packet = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    packet += b'<rdf:Description xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0"/>'
    Image.fromarray(ramp(np.uint8)).save(tmp_path / "a.jpg", xmp=packet + b"</rdf:RDF></x:xmpmeta>")
    assert any("gain map" in notice for notice in read_photo(tmp_path / "a.jpg").notices)
    Image.fromarray(ramp(np.uint8)).save(tmp_path / "b.jpg")
    assert read_photo(tmp_path / "b.jpg").notices == ()


def test_bits_are_chosen(tmp_path: Path) -> None:
    photo = Photo(ramp(np.uint8), ramp(np.uint8)[..., 0])
    wide = photo.with_bits(16)
    assert wide.bits == 16 and wide.alpha is not None and wide.alpha.dtype == np.uint16
    np.testing.assert_array_equal(wide.pixels // 257, photo.pixels)
    write_photo(tmp_path / "a.png", wide, {})
    assert read_photo(tmp_path / "a.png").bits == 16
    write_photo(tmp_path / "b.png", Photo(ramp()), {}, Encoding(bits=8))
    np.testing.assert_allclose(read_photo(tmp_path / "b.png").pixels, ramp() / 257, atol=0.51)


def test_bits_are_chosen_for_a_photo_with_curves(tmp_path: Path) -> None:
    from dior_rt.images.primaries import ADOBE_RGB, gamma_tag

    Image.fromarray(ramp(np.uint8)).save(
        tmp_path / "a.png", icc_profile=make_profile(ADOBE_RGB, gamma_tag(2.2))
    )
    photo = read_photo(tmp_path / "a.png")
    assert photo.curves is not None and photo.bits == 8
    write_photo(tmp_path / "b.png", photo.with_bits(16), {})
    again = read_photo(tmp_path / "b.png")
    assert again.bits == 16 and again.icc == photo.icc
    assert np.abs(again.pixels.astype(int) - photo.pixels).max() <= 40


def test_quality_decides_the_size(tmp_path: Path) -> None:
    photo = Photo(np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8))
    sizes = []
    for quality in (20, 60, 95):
        write_photo(tmp_path / f"{quality}.jpg", photo, {}, Encoding(quality))
        sizes.append((tmp_path / f"{quality}.jpg").stat().st_size)
    assert sizes == sorted(set(sizes))


@pytest.mark.parametrize(
    ("name", "encoding", "words"),
    [
        ("a.jpg", Encoding(bits=16), "JPEG holds 8 bits"),
        ("a.png", Encoding(bits=32), "PNG holds 8 or 16"),
        ("a.tif", Encoding(quality=50), "no quality"),
        ("a.exr", Encoding(bits=8), "EXR holds 16 or 32"),
    ],
)
def test_what_a_format_cannot_hold_is_said_before_the_work(tmp_path, name, encoding, words) -> None:
    with pytest.raises(InputError, match=words):
        check_output(tmp_path / name, Photo(ramp()), encoding)


def test_a_sidecar_says_how_the_picture_was_made(tmp_path: Path) -> None:
    write_sidecar(tmp_path / "a.jxl", Photo(ramp()), {"seed": 7})
    text = sidecar_path(tmp_path / "a.jxl").read_text()
    assert sidecar_path(tmp_path / "a.jxl").name == "a.xmp" and "seed" in text and "xmpmeta" in text


def test_kinds_are_told_by_their_content() -> None:
    assert find_reader(b"\x89PNG\r\n\x1a\n", ".heic") is None
    assert find_reader(b"II*\0\x08\0\0\0", ".tif") is None
    found = find_reader(b"II*\0\x08\0\0\0", ".NEF")
    assert found and found.extra == "raw"


def test_the_table_of_formats_is_what_the_formats_do(tmp_path: Path) -> None:
    """Read, 16 bits kept, profile kept, written: measured, and equal to the table in docs/formats.md."""
    for library in ("pillow_heif", "rawpy", "OpenImageIO", "tifffile"):
        pytest.importorskip(library)
    profile = make_profile(DISPLAY_P3, SRGB_TAG)
    rows = []
    for name, kind in (
        ("png", "PNG"), ("tif", "TIFF"), ("jpg", "JPEG"), ("webp", "WebP"), ("exr", "OpenEXR"),
        ("jxl", "JPEG XL"), ("heic", "HEIC"), ("dng", "camera raw"), ("psd", "Photoshop"), ("avif", "AVIF"),
    ):  # fmt: skip
        path = tmp_path / f"a.{name}"
        written, keeps_profile = True, False
        try:
            check_output(path, Photo(ramp(), icc=profile))
            write_photo(path, Photo(ramp(), icc=profile), {})
            keeps_profile = read_photo(path).icc == profile
        except InputError:
            try:
                write_photo(path, Photo(ramp()), {})
            except InputError:
                written = False
        if not written:
            make = {
                "heic": lambda path: write_heic(path, ramp(), 12),
                "dng": lambda path: write_dng(path, mosaic(ramp() // 2)),
                "psd": lambda path: write_psd(path, ramp(np.uint8)),
                "avif": lambda path: Image.fromarray(ramp(np.uint8)).save(path, icc_profile=profile),
            }
            make[name](path)
            if name == "heic":
                pytest.importorskip("pillow_heif").register_heif_opener()
                Image.fromarray(ramp(np.uint8)).save(tmp_path / "p.heic", icc_profile=profile)
                keeps_profile = read_photo(tmp_path / "p.heic").icc == profile
            elif name == "avif":
                keeps_profile = read_photo(path).icc == profile
        photo = read_photo(path)
        deep = photo.bits >= 16 and len(np.unique(photo.pixels)) > 256
        marks = ["yes" if mark else "no" for mark in (True, deep, keeps_profile, written)]
        extra = {"jxl": "`[jxl]`", "heic": "`[heic]`", "dng": "`[raw]`"}.get(name, "")
        rows.append(f"| {kind} | {' | '.join(marks)} | {extra} |")
    assert "\n".join(rows) in (ROOT / "docs" / "formats.md").read_text(), "\n".join(rows)
