"""Photos and strokes in memory: every kind that is accepted, and every kind that is refused."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms, ImageOps

from dior_rt.errors import InputError
from dior_rt.images.arrays import check_same_shape, in_primaries_of, like_photo, read_pixels, read_strokes
from dior_rt.kernels import Stroke, Strokes

sys.path.insert(0, str(Path(__file__).parent))
import icc

RGB = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
RGBA = np.random.default_rng(1).integers(0, 256, (5, 7, 4), dtype=np.uint8)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_arrays_pass_as_they_are(dtype):
    pixels = (RGB / 255 if dtype == np.float32 else RGB).astype(dtype)
    assert read_pixels(pixels) is pixels
    assert like_photo(pixels, pixels) is pixels


def test_images_keep_their_alpha_and_their_metadata():
    photo = Image.fromarray(RGBA)
    exif = Image.Exif()
    exif[0x010F] = "Camera Works"
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    photo.info = {"icc_profile": profile, "exif": exif.tobytes(), "comment": "not ours"}
    np.testing.assert_array_equal(read_pixels(photo), RGBA[..., :3])
    back = like_photo(255 - RGBA[..., :3], photo)
    assert back.mode == "RGBA" and set(back.info) == {"icc_profile", "exif"}
    assert back.info["icc_profile"] == profile
    assert back.getexif()[0x010F] == "Camera Works"
    np.testing.assert_array_equal(np.asarray(back)[..., 3], RGBA[..., 3])
    np.testing.assert_array_equal(np.asarray(back)[..., :3], 255 - RGBA[..., :3])


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_a_phone_photo_stands_upright(tmp_path, orientation, suffix):
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = orientation, "Camera Works"
    Image.fromarray(RGB).save(tmp_path / f"in.{suffix}", exif=exif.tobytes())
    with Image.open(tmp_path / f"in.{suffix}") as photo, Image.open(tmp_path / f"in.{suffix}") as twin:
        seen = np.asarray(ImageOps.exif_transpose(twin).convert("RGB"))
        pixels = read_pixels(photo)
        np.testing.assert_array_equal(pixels, seen)
        back = like_photo(pixels, photo)
    np.testing.assert_array_equal(np.asarray(back), seen)
    assert 0x0112 not in back.getexif() and back.getexif()[0x010F] == "Camera Works"


def test_light_is_drawn_in_the_primaries_of_the_photo():
    profile = icc.rgb_profile(icc.PROPHOTO, icc.gamma(1.8))
    photo = Image.fromarray(RGB)
    photo.info["icc_profile"] = profile
    expected = np.linalg.solve(icc.to_xyz(icc.PROPHOTO), icc.to_xyz(icc.SRGB)) @ (1, 0.5, 0.25)
    (stroke,) = in_primaries_of(photo, [Stroke(((1, 1),), 3.0, (1.0, 0.5, 0.25))])
    np.testing.assert_allclose(stroke.color, expected, atol=2e-3)
    light = np.broadcast_to(np.float32([1, 0.5, 0.25]), (4, 4, 3))
    converted = in_primaries_of(photo, Strokes(light, np.ones((4, 4), np.float32)))
    np.testing.assert_allclose(converted.light[2, 2], expected, atol=2e-3)
    plain = [Stroke(((1, 1),), 3.0)]
    assert in_primaries_of(RGB, plain) is plain


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "CMYK", "YCbCr", "RGBX"])
def test_images_of_other_modes_become_rgb(mode):
    photo = Image.fromarray(RGB).convert(mode)
    pixels = read_pixels(photo)
    np.testing.assert_array_equal(pixels, np.asarray(photo.convert("RGB")))
    assert like_photo(pixels, photo).mode == ("RGBA" if mode == "LA" else "RGB")


@pytest.mark.parametrize("mode", ["I", "F", "I;16"])
def test_images_without_8_bit_colour_are_refused(mode):
    with pytest.raises(InputError, match=mode):
        read_pixels(Image.new(mode, (4, 4)))
    with pytest.raises(InputError, match=mode):
        read_strokes(Image.new(mode, (4, 4)))


@pytest.mark.parametrize(
    "photo",
    [
        RGB[..., 0],
        RGB[None],
        RGBA,
        RGB.astype(np.float64),
        RGB.astype(np.int64),
        RGB[:0],
        np.full((2, 2, 3), np.nan, np.float32),
        np.full((2, 2, 3), np.inf, np.float32),
        np.full((2, 2, 3), -0.1, np.float32),
        "photo.jpg",
        None,
        Image.new("RGB", (0, 4)),
    ],
)
def test_what_is_no_photo_is_refused(photo):
    with pytest.raises(InputError) as refusal:
        read_pixels(photo)
    assert "\n" not in str(refusal.value)


def test_strokes_of_every_kind_say_the_same():
    light, mask = RGBA[..., :3], RGBA[..., 3]
    for strokes in (RGBA, Image.fromarray(RGBA)):
        got_light, got_mask = read_strokes(strokes)
        np.testing.assert_array_equal(got_light, light)
        np.testing.assert_array_equal(got_mask, mask)
    floats = np.concatenate([light * 10.0, mask[..., None] / 255.0], axis=2).astype(np.float32)
    for strokes in (floats, Strokes(floats[..., :3], floats[..., 3])):
        got_light, got_mask = read_strokes(strokes)
        np.testing.assert_array_equal(got_light, floats[..., :3])
        np.testing.assert_array_equal(got_mask, floats[..., 3])


def drawing(light=1.0, mask=1.0):
    return Strokes(np.full((4, 4, 3), light, np.float32), np.full((4, 4), mask, np.float32))


@pytest.mark.parametrize("light", [-0.001, np.nan, np.inf])
def test_light_that_cannot_be_is_refused_where_it_was_drawn(light):
    with pytest.raises(InputError, match="light"):
        read_strokes(drawing(light))
    read_strokes(drawing(light, mask=0.0))


@pytest.mark.parametrize("mask", [-0.1, 1.1, np.nan])
def test_a_mask_outside_its_range_is_refused(mask):
    with pytest.raises(InputError, match="mask"):
        read_strokes(drawing(mask=mask))


@pytest.mark.parametrize(
    "strokes",
    [
        RGB,
        Image.fromarray(RGB),
        Strokes(np.zeros((4, 4, 3), np.float32), np.zeros((4, 5), np.float32)),
        Strokes(np.zeros((4, 4), np.float32), np.zeros((4, 4), np.float32)),
        Strokes(np.zeros((0, 4, 3), np.float32), np.zeros((0, 4), np.float32)),
        None,
    ],
)
def test_what_is_no_strokes_is_refused(strokes):
    with pytest.raises(InputError):
        read_strokes(strokes)


@pytest.mark.parametrize(
    ("strokes", "photo"),
    [((300, 400), (3000, 4000)), ((333, 500), (2000, 3000)), ((1, 500), (3, 2000)), ((64, 64), (1009, 1000))],
)
def test_strokes_of_another_size_fit_where_the_shape_agrees(strokes, photo):
    check_same_shape(strokes, photo)
    check_same_shape(photo, strokes)


@pytest.mark.parametrize(
    ("strokes", "photo"), [((400, 300), (3000, 4000)), ((1000, 1000), (1000, 1030)), ((64, 64), (2000, 3000))]
)
def test_strokes_of_another_shape_are_refused(strokes, photo):
    with pytest.raises(InputError, match="shapes differ"):
        check_same_shape(strokes, photo)
