"""Photos through files and back, against Pillow's own transposition, pypng, tifffile and LittleCMS."""

from __future__ import annotations

import io
import json
import os
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import png
import pytest
import tifffile
from PIL import ExifTags, Image, ImageCms, ImageOps, PngImagePlugin

from dior_rt.errors import InputError
from dior_rt.images.icc import convert_to_srgb
from dior_rt.images.metadata import read_settings
from dior_rt.images.photo import MOST_PIXELS, Photo, check_output, read_photo, write_photo
from dior_rt.kernels.color import srgb_to_linear

sys.path.insert(0, str(Path(__file__).parent))
import icc

SETTINGS = {"bundle": "mini", "steps": 40, "seed": 7, "guidance": 1.5, "note": "naïve ☀"}
P3 = icc.rgb_profile(icc.DISPLAY_P3, icc.SRGB_CURVE)
ADOBE = icc.rgb_profile(icc.ADOBE_RGB, icc.gamma(563 / 256))
PROPHOTO = icc.rgb_profile(icc.PROPHOTO, icc.gamma(1.8))
COARSE = icc.rgb_profile(icc.ADOBE_RGB, icc.table(np.linspace(0, 1, 256) ** 2.2))


def scene(height: int = 23, width: int = 31, channels: int = 3, dtype: type = np.uint8) -> np.ndarray:
    """Return smooth colours with noise: no two corners, rows or columns are alike."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    waves = np.stack([np.sin(3 * x + c) * np.cos(2 * y * (c + 1)) for c in range(channels)], -1)
    values = np.clip(0.5 + 0.4 * waves + rng.normal(0, 0.05, waves.shape), 0, 1)
    return np.round(values * np.iinfo(dtype).max).astype(dtype)


def deep_png(path: Path, samples: np.ndarray, **options: object) -> None:
    """Write a 16-bit PNG by pypng."""
    height, width, channels = samples.shape
    writer = png.Writer(
        width, height, bitdepth=16, greyscale=channels < 3, alpha=channels in (2, 4), **options
    )
    with path.open("wb") as file:
        writer.write(file, samples.reshape(height, -1))


def read_deep_png(path: Path) -> np.ndarray:
    width, height, rows, info = png.Reader(filename=str(path)).read()
    assert info["bitdepth"] == 16
    return np.vstack(list(rows)).astype(np.uint16).reshape(height, width, info["planes"])


# Orientation and EXIF


def camera_exif(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Artist] = "A. Painter"
    exif[ExifTags.Base.Make] = "Camera Works"
    exif.get_ifd(ExifTags.IFD.Exif).update(
        {33434: 0.01, 37386: 35.0, 36867: "2024:05:06 07:08:09", 37500: b"note"}
    )
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({1: "N", 2: (47.0, 22.0, 10.5)})
    return exif


@pytest.mark.parametrize("orientation", [0, 1, 2, 3, 4, 5, 6, 7, 8, 9])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_a_photo_stands_as_a_viewer_shows_it(tmp_path: Path, orientation: int, suffix: str) -> None:
    path = tmp_path / f"in{suffix}"
    Image.fromarray(scene()).save(path, exif=camera_exif(orientation).tobytes())
    with Image.open(path) as image:
        seen = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))

    photo = read_photo(path)
    np.testing.assert_array_equal(photo.pixels, seen)

    out = tmp_path / "out.png"
    write_photo(out, photo, SETTINGS)
    with Image.open(out) as image:
        image.load()
        assert ExifTags.Base.Orientation not in image.getexif()
        np.testing.assert_array_equal(np.asarray(image), seen)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_exif_and_settings_go_along(tmp_path: Path, suffix: str, dtype: type) -> None:
    Image.fromarray(scene()).save(tmp_path / "in.jpg", exif=camera_exif(6).tobytes(), dpi=(300, 200))
    photo = replace(read_photo(tmp_path / "in.jpg"), pixels=scene(31, 23, dtype=dtype))
    out = tmp_path / f"out{suffix}"
    write_photo(out, photo, SETTINGS)

    assert read_settings(out) == SETTINGS
    with Image.open(out) as image:
        image.load()
        exif = image.getexif()
        assert exif[ExifTags.Base.Artist] == "A. Painter"
        assert exif[ExifTags.Base.Make] == "Camera Works"
        camera, place = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
        assert camera[36867] == "2024:05:06 07:08:09"
        assert float(camera[33434]) == pytest.approx(0.01)
        assert 37500 not in camera
        assert [float(v) for v in place[2]] == [47.0, 22.0, 10.5]
        if suffix != ".webp":  # it has no field for it
            # The camera held its pixels 300 across; upright they run down.
            assert [float(v) for v in image.info["dpi"]] == pytest.approx([200, 300], abs=0.1)


def test_a_stale_thumbnail_is_left_behind(tmp_path: Path) -> None:
    thumbnail = io.BytesIO()
    Image.new("RGB", (16, 12), "red").save(thumbnail, "JPEG")
    # EXIF by hand: one tag in the main directory, then a thumbnail directory, then the thumbnail.
    main = struct.pack("<H", 1) + struct.pack("<HHII", 0x0112, 3, 1, 1) + struct.pack("<I", 26)
    entries = ((0x0103, 3, 1, 6), (0x0201, 4, 1, 68), (0x0202, 4, 1, len(thumbnail.getvalue())))
    first = struct.pack("<H", 3) + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    exif = b"Exif\0\0II*\0\x08\0\0\0" + main + first + thumbnail.getvalue()
    Image.fromarray(scene()).save(tmp_path / "in.jpg", exif=exif)
    with Image.open(tmp_path / "in.jpg") as image:
        assert image.getexif().get_ifd(ExifTags.IFD.IFD1)[0x0202] == len(thumbnail.getvalue())

    write_photo(tmp_path / "out.jpg", read_photo(tmp_path / "in.jpg"), {})
    with Image.open(tmp_path / "out.jpg") as image:
        assert not image.getexif().get_ifd(ExifTags.IFD.IFD1)
    assert thumbnail.getvalue() not in (tmp_path / "out.jpg").read_bytes()


def test_damaged_exif_is_left_out_with_a_notice(tmp_path: Path) -> None:
    good = camera_exif(1).tobytes()
    for cut in range(8, len(good), 7):
        Image.fromarray(scene()).save(tmp_path / "in.jpg", exif=good[:cut])
        photo = read_photo(tmp_path / "in.jpg")
        write_photo(tmp_path / "out.jpg", photo, SETTINGS)
        assert read_settings(tmp_path / "out.jpg") == SETTINGS


# Depth


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("interlace", [False, True])
def test_16_bit_png_keeps_every_bit(tmp_path: Path, channels: int, interlace: bool) -> None:
    samples = scene(channels=channels, dtype=np.uint16)
    deep_png(tmp_path / "in.png", samples, interlace=interlace)
    photo = read_photo(tmp_path / "in.png")
    colours = channels - (channels in (2, 4))
    wanted = np.broadcast_to(samples[..., :colours], (*samples.shape[:2], 3))
    np.testing.assert_array_equal(photo.pixels, wanted)
    assert photo.bits == 16 and photo.pixels.dtype == np.uint16

    write_photo(tmp_path / "out.png", photo, SETTINGS)
    written = read_deep_png(tmp_path / "out.png")
    np.testing.assert_array_equal(written[..., :3], wanted)
    if photo.alpha is None:
        assert channels in (1, 3) and written.shape[-1] == 3
    else:
        np.testing.assert_array_equal(photo.alpha, samples[..., -1])
        np.testing.assert_array_equal(written[..., 3], samples[..., -1])


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib"}, {"compression": "zlib", "predictor": True}, {"tile": (16, 16)}]
)
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bit_tiff_keeps_every_bit(tmp_path: Path, channels: int, byteorder: str, options: dict) -> None:
    samples = scene(channels=channels, dtype=np.uint16)
    tifffile.imwrite(
        tmp_path / "in.tif",
        samples.squeeze(),
        photometric="rgb" if channels > 1 else "minisblack",
        extrasamples=["unassalpha"] if channels == 4 else None,
        byteorder=byteorder,
        **options,
    )
    photo = read_photo(tmp_path / "in.tif")
    np.testing.assert_array_equal(photo.pixels, np.broadcast_to(samples[..., :3], (23, 31, 3)))
    if channels == 4:
        np.testing.assert_array_equal(photo.alpha, samples[..., 3])

    write_photo(tmp_path / "out.tif", photo, SETTINGS)
    written = tifffile.imread(tmp_path / "out.tif")
    assert written.dtype == np.uint16
    np.testing.assert_array_equal(written, samples if channels > 1 else photo.pixels)


def test_16_bit_planes_are_read_right_or_refused(tmp_path: Path) -> None:
    samples = scene(dtype=np.uint16)
    for compression in (None, "zlib"):
        planes = np.moveaxis(samples, -1, 0)
        tifffile.imwrite(
            tmp_path / "in.tif", planes, photometric="rgb", planarconfig="separate", compression=compression
        )
        try:
            photo = read_photo(tmp_path / "in.tif")
        except InputError as error:
            assert "16-bit" in str(error)
        else:
            np.testing.assert_array_equal(photo.pixels, samples)


def test_white_is_zero_and_premultiplied_tiffs(tmp_path: Path) -> None:
    grey = scene(channels=1, dtype=np.uint16)[..., 0]
    tifffile.imwrite(tmp_path / "negative.tif", 65535 - grey, photometric="miniswhite")
    np.testing.assert_array_equal(read_photo(tmp_path / "negative.tif").pixels[..., 0], grey)

    straight = scene(channels=4, dtype=np.uint16)
    straight[..., 3] |= 0x4000
    multiplied = straight.copy()
    multiplied[..., :3] = np.round(straight[..., :3] * (straight[..., 3:] / 65535))
    tifffile.imwrite(tmp_path / "soft.tif", multiplied, photometric="rgb", extrasamples=["assocalpha"])
    photo = read_photo(tmp_path / "soft.tif")
    np.testing.assert_array_equal(photo.alpha, straight[..., 3])
    np.testing.assert_allclose(photo.pixels.astype(int), straight[..., :3], atol=4)


def test_a_16_bit_photo_is_rounded_for_jpeg_and_webp(tmp_path: Path) -> None:
    pixels = np.full((16, 16, 3), 200 * 257 + 128, np.uint16)
    for name in ("out.jpg", "out.webp"):
        write_photo(tmp_path / name, Photo(pixels), SETTINGS)
        with Image.open(tmp_path / name) as image:
            assert abs(int(np.asarray(image.convert("RGB"))[8, 8, 1]) - 200) <= 1


def test_one_transparent_colour(tmp_path: Path) -> None:
    deep = scene(dtype=np.uint16)
    key = tuple(int(v) for v in deep[3, 4])
    deep_png(tmp_path / "deep.png", deep, transparent=key)
    photo = read_photo(tmp_path / "deep.png")
    assert photo.alpha is not None and photo.alpha[3, 4] == 0 and (photo.alpha == 0).sum() == 1

    Image.fromarray(scene()).save(tmp_path / "flat.png", transparency=tuple(int(v) for v in scene()[3, 4]))
    photo = read_photo(tmp_path / "flat.png")
    assert photo.alpha is not None and photo.alpha[3, 4] == 0 and photo.alpha[0, 0] == 255


# Colour


@pytest.mark.parametrize("profile", [P3, ADOBE, PROPHOTO, COARSE], ids=["p3", "adobe", "prophoto", "coarse"])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_an_untouched_wide_gamut_photo_comes_out_as_it_went_in(
    tmp_path: Path, profile: bytes, suffix: str
) -> None:
    every_code = np.stack([np.arange(256), np.arange(256)[::-1], (np.arange(256) * 7) % 256], -1)
    pixels = np.repeat(every_code[None].astype(np.uint8), 4, 0)
    Image.fromarray(pixels).save(tmp_path / f"in{suffix}", icc_profile=profile)
    write_photo(tmp_path / f"out{suffix}", read_photo(tmp_path / f"in{suffix}"), SETTINGS)
    with Image.open(tmp_path / f"out{suffix}") as image:
        np.testing.assert_array_equal(np.asarray(image), pixels)
        assert image.info["icc_profile"] == profile


@pytest.mark.parametrize("profile", [P3, ADOBE, PROPHOTO, COARSE], ids=["p3", "adobe", "prophoto", "coarse"])
def test_curves_agree_with_littlecms(tmp_path: Path, profile: bytes) -> None:
    # The primaries do not change greys, so only the curve of a conversion to sRGB remains.
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, -1)
    Image.fromarray(ramp).save(tmp_path / "in.png", icc_profile=profile)
    ours = read_photo(tmp_path / "in.png").pixels
    ours = ours / np.iinfo(ours.dtype).max * 255
    theirs = np.asarray(convert_to_srgb(Image.fromarray(ramp), profile)).astype(float)
    assert np.abs(ours - theirs).max() <= 1.01


@pytest.mark.parametrize("profile", [P3, ADOBE, PROPHOTO], ids=["p3", "adobe", "prophoto"])
def test_half_the_light_of_a_wide_gamut_photo_is_half_the_light(tmp_path: Path, profile: bytes) -> None:
    # Muted colours, which LittleCMS can show in sRGB before and after without clipping.
    rng = np.random.default_rng(0)
    pixels = (128 + rng.integers(-20, 21, (24, 24, 3))).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "in.png", icc_profile=profile)
    photo = read_photo(tmp_path / "in.png")
    top = np.iinfo(photo.pixels.dtype).max
    halved = np.interp(
        srgb_to_linear(photo.pixels / top) / 2,
        srgb_to_linear(np.linspace(0, 1, 65536)),
        np.linspace(0, top, 65536),
    )
    write_photo(tmp_path / "out.png", replace(photo, pixels=np.round(halved).astype(photo.pixels.dtype)), {})

    with Image.open(tmp_path / "out.png") as image:
        after = srgb_to_linear(np.asarray(convert_to_srgb(image, image.info["icc_profile"])) / 255)
    before = srgb_to_linear(np.asarray(convert_to_srgb(Image.fromarray(pixels), profile)) / 255)
    # Three roundings to 8 bits, each up to 1.5 % of a middle grey's light, spread by the primaries' matrix.
    np.testing.assert_allclose(after, before / 2, rtol=0.07)
    assert abs(after.mean() / before.mean() - 0.5) < 0.002


def test_a_16_bit_wide_gamut_photo_keeps_its_depth_and_profile(tmp_path: Path) -> None:
    samples = scene(dtype=np.uint16)
    tifffile.imwrite(tmp_path / "in.tif", samples, photometric="rgb", iccprofile=ADOBE)
    for name in ("out.tif", "out.png"):
        write_photo(tmp_path / name, read_photo(tmp_path / "in.tif"), SETTINGS)
        with Image.open(tmp_path / name) as image:
            assert image.info["icc_profile"] == ADOBE
        photo = read_photo(tmp_path / name)
        assert photo.bits == 16
        again = photo.curves.from_srgb(photo.pixels)
        np.testing.assert_allclose(again.astype(int), samples, atol=32)  # an eighth of an 8-bit step


def test_a_grey_profile_is_honoured(tmp_path: Path) -> None:
    ramp = np.arange(256, dtype=np.uint8)[None]
    Image.fromarray(ramp).save(tmp_path / "in.png", icc_profile=icc.grey_profile(icc.gamma(1.0)))
    photo = read_photo(tmp_path / "in.png")
    assert (photo.pixels[..., 0] == photo.pixels[..., 2]).all() and photo.icc == b""
    np.testing.assert_allclose(srgb_to_linear(photo.pixels[0, :, 0] / 255), ramp[0] / 255, atol=0.005)


def test_a_table_profile_is_converted_to_srgb(tmp_path: Path) -> None:
    bits = np.array([[r, g, b] for r in (0, 1) for g in (0, 1) for b in (0, 1)])
    corners = bits @ icc.to_xyz(icc.ADOBE_RGB).T
    profile = icc.table_profile(b"RGB ", np.linspace(0, 1, 256) ** 2.2, corners)
    muted = scene() // 2 + 64  # inside sRGB's gamut
    Image.fromarray(muted).save(tmp_path / "in.png", icc_profile=profile)
    photo = read_photo(tmp_path / "in.png")
    # The same space made of a matrix and curves, by LittleCMS.
    twin = convert_to_srgb(Image.fromarray(muted), icc.rgb_profile(icc.ADOBE_RGB, icc.gamma(2.2)))
    np.testing.assert_allclose(photo.pixels.astype(int), np.asarray(twin), atol=2)
    assert ImageCms.ImageCmsProfile(io.BytesIO(photo.icc)).profile.profile_description.startswith("sRGB")

    deep = scene(dtype=np.uint16)
    tifffile.imwrite(tmp_path / "in.tif", deep, photometric="rgb", iccprofile=profile)
    photo = read_photo(tmp_path / "in.tif")
    assert photo.bits == 8 and "8-bit sRGB" in photo.notices[0]


def test_a_cmyk_profile_is_honoured(tmp_path: Path) -> None:
    inks = np.array([[c, m, y, k] for c in (0, 1) for m in (0, 1) for y in (0, 1) for k in (0, 1)])
    corners = ((1 - inks[:, :3]) * (1 - inks[:, 3:])) @ icc.to_xyz(icc.SRGB).T
    profile = icc.table_profile(b"CMYK", np.linspace(0, 1, 256), corners)
    patches = np.array([[[0, 0, 0, 0], [0, 255, 255, 0], [255, 0, 255, 0], [0, 0, 0, 128]]], np.uint8)
    picture = Image.fromarray(np.repeat(np.repeat(patches, 16, 0), 16, 1), "CMYK")
    picture.save(tmp_path / "in.tif", icc_profile=profile)
    seen = read_photo(tmp_path / "in.tif").pixels[8, 8::16]
    # The light of half the black ink is half, which sRGB writes as 188; without the profile it would be 127.
    np.testing.assert_allclose(seen.astype(int), [[255] * 3, [255, 0, 0], [0, 255, 0], [188] * 3], atol=2)


def test_profiles_that_do_not_fit_are_left_out_with_a_notice(tmp_path: Path) -> None:
    for profile in (P3[:200], b"nonsense" * 40, icc.grey_profile(icc.gamma(2.2))):
        Image.fromarray(scene()).save(tmp_path / "in.png", icc_profile=profile)
        photo = read_photo(tmp_path / "in.png")
        np.testing.assert_array_equal(photo.pixels, scene())
        assert photo.icc == b"" and "profile" in photo.notices[0]


def test_cmyk_palette_grey_and_one_bit(tmp_path: Path) -> None:
    picture = Image.fromarray(scene())
    picture.convert("CMYK").save(tmp_path / "cmyk.jpg", quality=100, subsampling=0)
    photo = read_photo(tmp_path / "cmyk.jpg")
    np.testing.assert_allclose(photo.pixels.astype(int), scene(), atol=8)

    indexed = picture.quantize(64)
    indexed.info["transparency"] = 3
    indexed.save(tmp_path / "palette.png")
    photo = read_photo(tmp_path / "palette.png")
    with Image.open(tmp_path / "palette.png") as image:
        np.testing.assert_array_equal(photo.alpha, np.where(np.asarray(image) == 3, 0, 255))
        np.testing.assert_array_equal(photo.pixels, np.asarray(image.convert("RGBA"))[..., :3])

    picture.convert("LA").save(tmp_path / "la.png")
    np.testing.assert_array_equal(
        read_photo(tmp_path / "la.png").pixels[..., 1], np.asarray(picture.convert("L"))
    )

    bits = scene(channels=1)[..., 0] > 128
    Image.fromarray(bits).save(tmp_path / "bits.png")
    np.testing.assert_array_equal(read_photo(tmp_path / "bits.png").pixels[..., 0], bits * 255)


def test_alpha_is_carried_through(tmp_path: Path) -> None:
    rgba = scene(channels=4)
    Image.fromarray(rgba).save(tmp_path / "in.png")
    for suffix in (".png", ".tif", ".webp"):
        write_photo(tmp_path / f"out{suffix}", read_photo(tmp_path / "in.png"), SETTINGS)
        with Image.open(tmp_path / f"out{suffix}") as image:
            np.testing.assert_array_equal(np.asarray(image)[..., 3], rgba[..., 3])
    with pytest.raises(InputError, match="transparency"):
        check_output(tmp_path / "out.jpg", read_photo(tmp_path / "in.png"))

    rgba[..., 3] = 255
    Image.fromarray(rgba).save(tmp_path / "opaque.png")
    photo = read_photo(tmp_path / "opaque.png")
    check_output(tmp_path / "out.jpg", photo)
    write_photo(tmp_path / "out.jpg", photo, SETTINGS)
    assert read_photo(tmp_path / "out.jpg").alpha is None


def test_of_many_frames_the_first_is_taken_and_said(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (8, 8), colour) for colour in ("red", "blue")]
    for name in ("a.gif", "a.tif", "a.webp", "a.png"):
        frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:])
        photo = read_photo(tmp_path / name)
        assert "first" in photo.notices[0]
        assert photo.pixels[4, 4, 0] > 200 > 50 > photo.pixels[4, 4, 2]


# Refusals


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_photo(path)
    text = str(caught.value)
    assert str(path) in text and text.endswith(".") and "\n" not in text and "<" not in text
    return text


def test_files_that_are_no_photos(tmp_path: Path) -> None:
    assert "no such file" in refused(tmp_path / "missing.png")
    assert "folder" in refused(tmp_path)
    (tmp_path / "empty.png").touch()
    assert "empty" in refused(tmp_path / "empty.png")
    (tmp_path / "words.png").write_text("not a picture")
    assert "not a picture" in refused(tmp_path / "words.png")
    (tmp_path / "phone.heic").write_bytes(struct.pack(">I", 24) + b"ftypheic" + bytes(60))
    assert "HEIC" in refused(tmp_path / "phone.heic")
    (tmp_path / "page.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n")
    assert "not a picture" in refused(tmp_path / "page.eps")
    with pytest.raises(InputError):
        read_photo(Path("nul\0l.png"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    assert "regular file" in refused(tmp_path / "pipe.png")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".gif"])
def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"in{suffix}"
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    for share in (0.05, 0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(len(whole) * share)])
        refused(path)


def test_a_16_bit_file_cut_short_is_refused(tmp_path: Path) -> None:
    deep_png(tmp_path / "in.png", scene(dtype=np.uint16))
    tifffile.imwrite(tmp_path / "in.tif", scene(dtype=np.uint16), photometric="rgb")
    for path in (tmp_path / "in.png", tmp_path / "in.tif"):
        whole = path.read_bytes()
        for share in (0.05, 0.3, 0.6, 0.9):
            path.write_bytes(whole[: int(len(whole) * share)])
            refused(path)


def test_damaged_bytes_never_escape_as_another_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for suffix in (".jpg", ".png", ".tif", ".webp"):
        path = tmp_path / f"in{suffix}"
        Image.fromarray(scene()).save(path, exif=camera_exif(6).tobytes(), icc_profile=ADOBE)
        whole = np.frombuffer(path.read_bytes(), np.uint8)
        for _ in range(150):
            harmed = whole.copy()
            harmed[rng.integers(0, len(whole), 3)] = rng.integers(0, 256, 3)
            path.write_bytes(harmed.tobytes())
            try:
                read_photo(path)
            except InputError as error:
                assert "\n" not in str(error)


def test_a_bomb_is_refused_by_its_header(tmp_path: Path) -> None:
    header = struct.pack(">2I5B", 60000, 60000, 8, 2, 0, 0, 0)
    with (tmp_path / "bomb.png").open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        PngImagePlugin.putchunk(file, b"IHDR", header)
        PngImagePlugin.putchunk(file, b"IDAT", zlib.compress(bytes(1_000_000)))
        PngImagePlugin.putchunk(file, b"IEND", b"")
    assert "megapixels" in refused(tmp_path / "bomb.png")

    Image.new("1", (MOST_PIXELS // 10_000 + 1, 10_000)).save(tmp_path / "large.png")
    assert "megapixels" in refused(tmp_path / "large.png")


def test_a_large_photo_is_no_bomb(tmp_path: Path) -> None:
    Image.new("L", (12_000, 8_400), 9).save(tmp_path / "large.png")  # Pillow warns from 89 megapixels on
    photo = read_photo(tmp_path / "large.png")
    assert photo.size == (8_400, 12_000) and photo.notices == ()


def test_depths_that_would_be_cut_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "float.tif", scene(channels=1)[..., 0].astype(np.float32))
    assert "floating-point" in refused(tmp_path / "float.tif")
    tifffile.imwrite(tmp_path / "rgb.tif", scene().astype(np.float32), photometric="rgb")
    refused(tmp_path / "rgb.tif")
    tifffile.imwrite(tmp_path / "int.tif", scene(channels=1)[..., 0].astype(np.int32))
    assert "32-bit" in refused(tmp_path / "int.tif")


# Writing


def test_outputs_that_cannot_be_written_are_known_beforehand(tmp_path: Path) -> None:
    photo = Photo(scene())
    (tmp_path / "file").write_text("a file")
    cases = {
        tmp_path / "out.bmp": "must end in",
        tmp_path / "out": "must end in",
        tmp_path / "none" / "out.png": "does not exist",
        tmp_path / "file" / "out.png": "does not exist",
        tmp_path / ("x" * 300 + ".png"): "name too long",
    }
    if sys.platform == "linux":
        cases[Path("/proc/out.png")] = "Cannot write"  # nobody can make a file there, root included
    for path, words in cases.items():
        with pytest.raises(InputError, match=words):
            check_output(path, photo)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match="folder"):
        check_output(tmp_path / "folder.png", photo)
    with pytest.raises(InputError, match="16383 pixels a side"):
        check_output(tmp_path / "out.webp", Photo(np.zeros((1, 17_000, 3), np.uint8)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.png"]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out.webp"
    out.write_bytes(b"the old one")
    with pytest.raises(InputError, match="Cannot write"):
        write_photo(out, Photo(np.zeros((1, 17_000, 3), np.uint8)), SETTINGS)
    assert out.read_bytes() == b"the old one"
    assert list(tmp_path.iterdir()) == [out]


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Image.Image, "save", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_photo(tmp_path / "out.png", Photo(scene()), SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_names_links_and_permissions(tmp_path: Path) -> None:
    folder = tmp_path / "été ☀ 光"
    folder.mkdir()
    Image.fromarray(scene()).save(folder / "grün.png")
    photo = read_photo(folder / "grün.png")
    write_photo(folder / "röd.PNG", photo, SETTINGS)
    np.testing.assert_array_equal(read_photo(folder / "röd.PNG").pixels, scene())

    (folder / "made.png").touch()
    assert (folder / "röd.PNG").stat().st_mode == (folder / "made.png").stat().st_mode

    (folder / "link.png").symlink_to("made.png")
    write_photo(folder / "link.png", photo, SETTINGS)
    assert (folder / "link.png").is_symlink()
    np.testing.assert_array_equal(read_photo(folder / "made.png").pixels, scene())


def test_settings_stand_as_text_in_a_png(tmp_path: Path) -> None:
    for name, dtype in (("8.png", np.uint8), ("16.png", np.uint16)):
        write_photo(tmp_path / name, Photo(scene(dtype=dtype)), SETTINGS)
        with Image.open(tmp_path / name) as image:
            image.load()
            assert json.loads(image.text["Dior"]) == SETTINGS  # type: ignore[attr-defined]
    Image.fromarray(scene()).save(tmp_path / "other.png")
    with pytest.raises(InputError, match="how it was made"):
        read_settings(tmp_path / "other.png")
