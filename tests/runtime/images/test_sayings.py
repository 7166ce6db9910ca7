"""The facts that a file states: metadata, colour, depth, pages and place, each with the correct value."""

from __future__ import annotations

import json
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image, PngImagePlugin

from dior_rt.errors import InputError
from dior_rt.images.directories import Reader, entry, pack
from dior_rt.images.icc import convert_to_srgb
from dior_rt.images.metadata import read_settings
from dior_rt.images.photo import read_photo, write_photo
from dior_rt.images.primaries import SRGB, make_profile, srgb, to_xyz
from dior_rt.images.strokes import read_drawing, read_lumi, read_strokes

sys.path.insert(0, str(Path(__file__).parent))
import icc

PROPHOTO = icc.rgb_profile(icc.PROPHOTO, icc.gamma(1.8))
P3 = icc.rgb_profile(icc.DISPLAY_P3, icc.SRGB_CURVE)
SIZE = (23, 31)


def scene(height: int = 23, width: int = 31, dtype: type = np.uint8, channels: int = 3) -> np.ndarray:
    """Return noise: no two corners, rows or columns are alike."""
    rng = np.random.default_rng(5)
    return rng.integers(0, np.iinfo(dtype).max, (height, width, channels), dtype=dtype, endpoint=True)


def with_chunks(path: Path, *chunks: tuple[bytes, bytes]) -> None:
    """Put chunks into a PNG behind its header."""
    data = path.read_bytes()
    packed = b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )
    path.write_bytes(data[:33] + packed + data[33:])


def refused(path: Path, **options: int) -> str:
    with pytest.raises(InputError) as caught:
        read_photo(path, **options)
    text = str(caught.value)
    assert text.endswith(".") and "\n" not in text
    return text


# Orientation


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_tiff_of_any_depth_is_turned_once(
    tmp_path: Path, orientation: int, compression: str | None, channels: int, dtype: type
) -> None:
    samples = scene(dtype=dtype, channels=channels)
    tifffile.imwrite(
        tmp_path / "in.tif",
        samples.squeeze(),
        photometric="minisblack" if channels == 1 else "rgb",
        extrasamples=["unassalpha"] if channels == 4 else None,
        compression=compression,
        extratags=[(274, "H", 1, orientation, True)],
    )
    turned = {
        1: samples,
        2: samples[:, ::-1],
        3: samples[::-1, ::-1],
        4: samples[::-1],
        5: samples.swapaxes(0, 1),
        6: np.rot90(samples, -1),
        7: samples.swapaxes(0, 1)[::-1, ::-1],
        8: np.rot90(samples),
    }[orientation]
    photo = read_photo(tmp_path / "in.tif")
    np.testing.assert_array_equal(photo.pixels, np.broadcast_to(turned[..., :3], (*turned.shape[:2], 3)))
    if channels == 4:
        np.testing.assert_array_equal(photo.alpha, turned[..., 3])


XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="6" '
    'xmlns:dc="http://purl.org/dc/elements/1.1/" '
    'xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/" '
    'Iptc4xmpExt:DigitalSourceType="http://cv.iptc.org/newscodes/digitalsourcetype/digitalCapture">'
    "<dc:subject><rdf:Bag><rdf:li>évening ☀</rdf:li></rdf:Bag></dc:subject>"
    "</rdf:Description></rdf:RDF></x:xmpmeta>"
).encode()
COMPOSITE = "http://cv.iptc.org/newscodes/digitalsourcetype/compositeWithTrainedAlgorithmicMedia"


def save_with_xmp(path: Path, samples: np.ndarray) -> None:
    if path.suffix == ".tif":
        tifffile.imwrite(path, samples, photometric="rgb", extratags=[(700, "B", len(XMP), XMP, True)])
    elif path.suffix == ".png":
        info = PngImagePlugin.PngInfo()
        info.add_itxt("XML:com.adobe.xmp", XMP.decode())
        Image.fromarray(samples).save(path, pnginfo=info)
    else:
        Image.fromarray(samples).save(path, xmp=XMP, lossless=True)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jpg"])
def test_an_orientation_that_stands_in_xmp_alone_turns_nothing(tmp_path: Path, suffix: str) -> None:
    save_with_xmp(tmp_path / f"in{suffix}", scene())
    photo = read_photo(tmp_path / f"in{suffix}")
    assert photo.size == SIZE
    if suffix != ".jpg":
        np.testing.assert_array_equal(photo.pixels, scene())


# Metadata


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jpg"])
def test_xmp_is_kept_and_says_where_the_picture_comes_from(tmp_path: Path, suffix: str) -> None:
    save_with_xmp(tmp_path / "in.png", scene())
    write_photo(tmp_path / f"out{suffix}", read_photo(tmp_path / "in.png"), {"seed": 3, "note": 'naïve <&"'})
    with Image.open(tmp_path / f"out{suffix}") as image:
        image.load()
        packet = image.info["xmp"].decode()
    assert "évening ☀" in packet and packet.count("DigitalSourceType=") == 1 and COMPOSITE in packet
    assert "Orientation" not in packet
    assert read_settings(tmp_path / f"out{suffix}") == {"seed": 3, "note": 'naïve <&"'}


def test_damaged_xmp_is_left_out_with_a_notice(tmp_path: Path) -> None:
    bomb = b'<!DOCTYPE x [<!ENTITY a "b">]>' + XMP
    for packet in (XMP[:200], b"nonsense", bomb):
        Image.fromarray(scene()).save(tmp_path / "in.jpg", xmp=packet)
        photo = read_photo(tmp_path / "in.jpg")
        assert "XMP" in photo.notices[0] and photo.xmp == b""


IPTC = b"\x1c\x02\x50\x00\x09A Painter"


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp"])
@pytest.mark.parametrize("source", [".jpg", ".tif", ".png"])
def test_iptc_is_kept_where_the_format_holds_it(tmp_path: Path, source: str, suffix: str) -> None:
    first = tmp_path / "first.jpg"
    block = (
        b"Photoshop 3.0\0" + b"8BIM\x04\x04\0\0" + struct.pack(">I", len(IPTC)) + IPTC + bytes(len(IPTC) % 2)
    )
    segment = b"\xff\xed" + struct.pack(">H", len(block) + 2) + block
    Image.fromarray(scene()).save(first, extra=segment)
    write_photo(tmp_path / f"in{source}", read_photo(first), {})
    photo = read_photo(tmp_path / f"in{source}")
    assert photo.iptc == IPTC
    lost = write_photo(tmp_path / f"out{suffix}", photo, {})
    if suffix == ".webp":
        assert "IPTC" in lost[0]
    else:
        assert lost == () and read_photo(tmp_path / f"out{suffix}").iptc == IPTC


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp"])
@pytest.mark.parametrize("kind", [1, 7])  # BYTE, as Pillow writes it, and UNDEFINED, as EXIF wants it
def test_the_photographers_own_comment_stays_and_has_the_right_type(
    tmp_path: Path, suffix: str, kind: int
) -> None:
    comment = b"ASCII\0\0\0my own words"
    exif = {0x9000: entry(7, b"0232"), 0x9286: entry(kind, comment)}
    Image.fromarray(scene()).save(
        tmp_path / "in.jpg", exif=b"Exif\0\0II*\0\x08\0\0\0" + pack({}, {ExifTags.IFD.Exif: exif})
    )
    write_photo(tmp_path / f"out{suffix}", read_photo(tmp_path / "in.jpg"), {"seed": 1})
    with Image.open(tmp_path / f"out{suffix}") as image:
        image.load()
        data = image.info.get("exif")
    reader = Reader(data.removeprefix(b"Exif\0\0") if data else (tmp_path / f"out{suffix}").read_bytes())
    main, _ = reader.directory(reader.first)
    camera, _ = reader.directory(int(main[ExifTags.IFD.Exif].numbers()[0]))
    assert (camera[0x9286].kind, camera[0x9286].data) == (7, comment)
    assert camera[0x9000].kind == 7 and not reader.damaged


# Colour


def light_of(pixels: np.ndarray, space: tuple) -> np.ndarray:
    """Return XYZ under D50 of 8-bit pixels on the sRGB curve."""
    from dior_rt.kernels.color import srgb_to_linear

    return srgb_to_linear(pixels / np.iinfo(pixels.dtype).max) @ icc.to_xyz(space).T


def test_the_profiles_that_are_made_mean_what_littlecms_reads() -> None:
    np.testing.assert_allclose(to_xyz(SRGB), icc.to_xyz(icc.SRGB), atol=1e-3)
    ramp = scene() // 2 + 60
    profile = make_profile((0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329), icc.SRGB_CURVE)
    ours, theirs = (convert_to_srgb(Image.fromarray(ramp), one) for one in (profile, P3))
    np.testing.assert_allclose(np.asarray(ours).astype(int), np.asarray(theirs), atol=1)


def test_png_says_display_p3_by_cicp_or_by_chromaticities(tmp_path: Path) -> None:
    xy = [0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06]
    chrm = struct.pack(">8I", *(round(v * 100_000) for v in xy))
    for name, chunk in (("cicp", (b"cICP", b"\x0c\x0d\0\1")), ("chrm", (b"cHRM", chrm))):
        path = tmp_path / f"{name}.png"
        Image.fromarray(scene()).save(path)
        with_chunks(path, chunk)
        photo = read_photo(path)
        np.testing.assert_array_equal(photo.pixels, scene())  # the curve is sRGB's
        np.testing.assert_allclose(photo.primaries, icc.to_xyz(icc.DISPLAY_P3), atol=1e-3)
        write_photo(tmp_path / "out.png", photo, {})
        np.testing.assert_allclose(read_photo(tmp_path / "out.png").primaries, photo.primaries, atol=1e-3)


def test_png_gamma_is_honoured_and_comes_out_as_it_went_in(tmp_path: Path) -> None:
    Image.fromarray(scene()).save(tmp_path / "in.png")
    with_chunks(tmp_path / "in.png", (b"gAMA", struct.pack(">I", 100_000)))  # linear
    photo = read_photo(tmp_path / "in.png")
    from dior_rt.kernels.color import srgb_to_linear

    np.testing.assert_allclose(srgb_to_linear(photo.pixels / 65535), scene() / 255, atol=1e-4)
    write_photo(tmp_path / "out.png", photo, {})
    with Image.open(tmp_path / "out.png") as image:
        np.testing.assert_array_equal(np.asarray(image), scene())
    # Most programs use 0.45455 to mean sRGB, and the chunk sRGB overrides both.
    for chunks in (
        [(b"gAMA", struct.pack(">I", 45_455))],
        [(b"sRGB", b"\0"), (b"gAMA", struct.pack(">I", 100_000))],
    ):
        Image.fromarray(scene()).save(tmp_path / "in.png")
        with_chunks(tmp_path / "in.png", *chunks)
        photo = read_photo(tmp_path / "in.png")
        assert photo.icc == b"" and photo.curves is None


def test_hdr_is_refused_by_its_name(tmp_path: Path) -> None:
    for transfer, name in ((16, "PQ"), (18, "HLG")):
        Image.fromarray(scene()).save(tmp_path / "in.png")
        with_chunks(tmp_path / "in.png", (b"cICP", bytes([9, transfer, 0, 1])))
        text = refused(tmp_path / "in.png")
        assert name in text and "SDR" in text


def avif(path: Path, primaries: int, transfer: int) -> None:
    """Write an AVIF whose colr box holds these codes."""
    Image.fromarray(scene(64, 64)).save(path, quality=100, subsampling="4:4:4")
    data = bytearray(path.read_bytes())
    at = data.index(b"colrnclx")
    struct.pack_into(">2H", data, at + 8, primaries, transfer)
    path.write_bytes(data)


def test_avif_nclx_is_honoured(tmp_path: Path) -> None:
    avif(tmp_path / "p3.avif", 12, 13)
    np.testing.assert_allclose(
        read_photo(tmp_path / "p3.avif").primaries, icc.to_xyz(icc.DISPLAY_P3), atol=1e-3
    )
    avif(tmp_path / "plain.avif", 1, 13)
    assert read_photo(tmp_path / "plain.avif").icc == b""
    avif(tmp_path / "pq.avif", 9, 16)
    assert "PQ" in refused(tmp_path / "pq.avif")


def test_a_camera_says_adobe_rgb_by_exif_alone(tmp_path: Path) -> None:
    camera = {0xA001: entry(3, 65535)}
    marks = {1: entry(2, b"R03\0"), 2: entry(7, b"0100")}
    body = pack({}, {ExifTags.IFD.Exif: camera})
    # The interoperability directory hangs below EXIF's: two levels, put together by hand.
    at = 8 + len(body) + 18
    camera[0xA005] = entry(4, at)
    body = pack({}, {ExifTags.IFD.Exif: camera})
    exif = b"II*\0\x08\0\0\0" + body
    exif += bytes(at - len(exif)) + pack(marks, {}, at)
    Image.fromarray(scene()).save(tmp_path / "in.jpg", exif=b"Exif\0\0" + exif, quality=100, subsampling=0)
    photo = read_photo(tmp_path / "in.jpg")
    np.testing.assert_allclose(photo.primaries, icc.to_xyz(icc.ADOBE_RGB), atol=1e-3)
    # The curve is a power of 2.2: code 128 is light 0.2195.
    assert photo.curves is not None
    write_photo(tmp_path / "out.jpg", photo, {})
    with Image.open(tmp_path / "out.jpg") as image:
        assert image.info["icc_profile"] == photo.icc


def test_strokes_are_converted_to_the_photos_primaries_in_linear_light(tmp_path: Path) -> None:
    rgba = np.zeros((*SIZE, 4), np.uint8)
    rgba[3:9, 3:9] = (200, 0, 0, 255)
    Image.fromarray(rgba).save(tmp_path / "s.png")
    Image.fromarray(scene()).save(tmp_path / "photo.png", icc_profile=PROPHOTO)
    photo = read_photo(tmp_path / "photo.png")
    raster = read_drawing(tmp_path / "s.png", SIZE, primaries=photo.primaries).strokes
    from dior_rt.kernels.color import linear_to_srgb, srgb_to_linear

    wanted = np.linalg.solve(icc.to_xyz(icc.PROPHOTO), icc.to_xyz(icc.SRGB)) @ srgb_to_linear(
        [200 / 255, 0, 0]
    )
    np.testing.assert_allclose(raster[5, 5, :3], wanted, rtol=0.01)
    assert (raster[5, 5, 3], raster[15, 15, 3]) == (1, 0)
    assert (linear_to_srgb(raster[5, 5, :3]) * 255 > (100, 20, 1)).all()

    # The same light in ProPhoto's own numbers needs no conversion.
    Image.fromarray(rgba).save(
        tmp_path / "own.png", icc_profile=icc.rgb_profile(icc.PROPHOTO, icc.SRGB_CURVE)
    )
    own = read_drawing(tmp_path / "own.png", SIZE, primaries=photo.primaries).strokes
    np.testing.assert_array_equal(own, rgba)
    # Over a photo of sRGB it is brought there.
    brought = read_strokes(tmp_path / "own.png", SIZE)
    assert brought.dtype == np.float32 and brought[5, 5, 0] > srgb_to_linear(200 / 255)

    stroke = {"points": [[1, 2]], "width": 3, "color": "#c80000", "intensity": 2}
    (tmp_path / "s.json").write_text(json.dumps([stroke]))
    (converted,) = read_drawing(tmp_path / "s.json", SIZE, primaries=photo.primaries).strokes
    np.testing.assert_allclose(converted.light, 2 * wanted, rtol=0.01)


def test_an_exr_of_other_chromaticities_is_its_twin(tmp_path: Path) -> None:
    import OpenEXR

    rng = np.random.default_rng(0)
    plain = rng.random((6, 8, 3)).astype(np.float32)
    wide = (plain @ np.linalg.solve(icc.to_xyz(icc.DISPLAY_P3), icc.to_xyz(icc.SRGB)).T).astype(np.float32)
    xy = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)
    OpenEXR.File({"chromaticities": xy}, {"RGB": wide}).write(str(tmp_path / "wide.exr"))
    np.testing.assert_allclose(read_lumi(tmp_path / "wide.exr"), plain, atol=2e-3)
    strokes = read_strokes(tmp_path / "wide.exr", (6, 8))
    np.testing.assert_allclose(strokes[..., :3], plain, atol=2e-3)
    own = read_drawing(tmp_path / "wide.exr", (6, 8), primaries=icc.to_xyz(icc.DISPLAY_P3)).strokes
    np.testing.assert_array_equal(own[..., :3], wide)
    assert np.abs(srgb() - icc.to_xyz(icc.SRGB)).max() < 1e-3


def test_the_key_refuses_files_that_blur_black(tmp_path: Path) -> None:
    rgb = np.zeros((*SIZE, 3), np.uint8)
    rgb[5:15, 5:15] = 255
    Image.fromarray(rgb).save(tmp_path / "s.webp", lossless=True)
    assert set(read_strokes(tmp_path / "s.webp", SIZE, key="black")[..., 3].flat) == {0, 255}
    for name, options in (("s.jpg", {}), ("lossy.webp", {"quality": 60})):
        Image.fromarray(rgb).save(tmp_path / name, **options)
        with pytest.raises(InputError, match="save them as PNG"):
            read_strokes(tmp_path / name, SIZE, key="black")


def test_notices_of_the_strokes_file_are_passed_on(tmp_path: Path) -> None:
    Image.fromarray(scene(channels=4)).save(tmp_path / "s.png", icc_profile=b"nonsense" * 40)
    assert "profile" in read_drawing(tmp_path / "s.png", SIZE).notices[0]


# Kinds and depths


def raw_file(path: Path, order: str = "<") -> None:
    """Write the minimal parts of a DNG: a thumbnail in front, the mosaic in a directory below."""
    small = scene(10, 16).tobytes()
    tifffile.imwrite(
        path,
        scene(10, 16),
        photometric="rgb",
        byteorder=order,
        extratags=[(254, "I", 1, 1, True), (50706, "B", 4, (1, 4, 0, 0), True)],
    )
    assert small


def test_camera_raw_is_refused_and_not_relit_as_its_thumbnail(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)  # with it, they are developed
    monkeypatch.delitem(sys.modules, "dior_rt.images.raw", raising=False)
    for order in "<>":
        raw_file(tmp_path / "a.dng", order)
        assert "camera raw" in refused(tmp_path / "a.dng")
    # As a NEF or ARW: no DNGVersion, but a mosaic in a sub-directory.
    with tifffile.TiffWriter(tmp_path / "a.nef") as writer:
        writer.write(scene(10, 16), photometric="rgb", subifds=1, subfiletype=1)
        writer.write(scene(channels=1, dtype=np.uint16)[..., 0], photometric="cfa", extratags=[])
    assert "camera raw" in refused(tmp_path / "a.nef")
    for name, head in (
        ("a.raf", b"FUJIFILMCCD-RAW 0201"),
        ("a.cr3", b"\0\0\0\x18ftypcrx isom"),
        ("a.orf", b"IIRO\x08"),
    ):
        (tmp_path / name).write_bytes(head + bytes(100))
        assert "camera raw" in refused(tmp_path / name) and "dior-rt[raw]" in refused(tmp_path / name)
    # A plain TIFF with a smaller copy of itself below is none.
    with tifffile.TiffWriter(tmp_path / "pyramid.tif") as writer:
        writer.write(scene(), photometric="rgb", subifds=1)
        writer.write(scene()[::2, ::2], photometric="rgb", subfiletype=1)
    np.testing.assert_array_equal(read_photo(tmp_path / "pyramid.tif").pixels, scene())


def test_depths_are_named_with_what_to_do(tmp_path: Path) -> None:
    for dtype, words in ((np.float32, "32-bit floating-point"), (np.float16, "16-bit floating-point")):
        tifffile.imwrite(tmp_path / "in.tif", scene().astype(dtype), photometric="rgb")
        text = refused(tmp_path / "in.tif")
        assert words in text and "16-bit RGB PNG or TIFF" in text
    tifffile.imwrite(tmp_path / "in.tif", scene(dtype=np.uint16), photometric="cielab")
    assert "16-bit Lab" in refused(tmp_path / "in.tif")
    tifffile.imwrite(tmp_path / "in.tif", scene().astype(np.uint32), photometric="rgb")
    assert "32-bit samples" in refused(tmp_path / "in.tif")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_bigtiff_is_read(tmp_path: Path, dtype: type) -> None:
    tifffile.imwrite(tmp_path / "in.tif", scene(dtype=dtype), photometric="rgb", bigtiff=True)
    np.testing.assert_array_equal(read_photo(tmp_path / "in.tif").pixels, scene(dtype=dtype))


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("plain", [False, True])
def test_netpbm_keeps_16_bits(tmp_path: Path, channels: int, plain: bool) -> None:
    samples = scene(dtype=np.uint16, channels=channels)
    kind = (3 if channels == 3 else 2) if plain else (6 if channels == 3 else 5)
    head = f"P{kind}\n# a comment\n31 23\n65535\n".encode()
    body = " ".join(map(str, samples.ravel())).encode() if plain else samples.astype(">u2").tobytes()
    (tmp_path / "in.ppm").write_bytes(head + body)
    photo = read_photo(tmp_path / "in.ppm")
    assert photo.bits == 16
    np.testing.assert_array_equal(photo.pixels, np.broadcast_to(samples, (*SIZE, 3)))
    (tmp_path / "in.ppm").write_bytes(head + body[: len(body) // 2])
    refused(tmp_path / "in.ppm")


def test_bits_that_are_not_read_are_said(tmp_path: Path) -> None:
    avif(tmp_path / "in.avif", 1, 13)
    data = bytearray((tmp_path / "in.avif").read_bytes())
    at = data.index(b"av1C")
    data[at + 6] |= 0x60  # high bit depth, twelve bits; the stream itself stays as it is
    (tmp_path / "in.avif").write_bytes(data)
    from dior_rt.images.boxes import read_boxes

    with (tmp_path / "in.avif").open("rb") as file:
        assert read_boxes(file).bits == 12
    Image.fromarray(scene(dtype=np.uint16, channels=1)[..., 0]).save(
        tmp_path / "grey.jp2", irreversible=False
    )
    assert read_photo(tmp_path / "grey.jp2").bits == 16
    with (tmp_path / "grey.jp2").open("rb") as file:
        assert read_boxes(file).bits == 16


# Pages and places


def test_the_page_that_was_read_is_said_and_another_can_be_chosen(tmp_path: Path) -> None:
    pages = [scene(channels=4), 255 - scene(channels=4)]
    with tifffile.TiffWriter(tmp_path / "in.tif") as writer:
        for page in pages:
            writer.write(page, photometric="rgb", extrasamples=["unassalpha"])
    for number, page in enumerate(pages):
        drawing = read_drawing(tmp_path / "in.tif", SIZE, page=number)
        np.testing.assert_array_equal(drawing.strokes, page)
        assert f"2 pages; page {number}" in drawing.notices[0] and "--page" in drawing.notices[0]
    with pytest.raises(InputError, match="0 to 1"):
        read_drawing(tmp_path / "in.tif", SIZE, page=2)


def test_a_layer_of_a_tiff_lies_where_its_page_says(tmp_path: Path) -> None:
    layer = scene(6, 9, channels=4)
    with tifffile.TiffWriter(tmp_path / "in.tif") as writer:
        writer.write(scene(channels=4), photometric="rgb", extrasamples=["unassalpha"], resolution=(72, 72))
        place = [(286, "2I", 1, (7, 72), True), (287, "2I", 1, (4, 72), True)]
        writer.write(
            layer, photometric="rgb", extrasamples=["unassalpha"], resolution=(72, 72), extratags=place
        )
    raster = read_drawing(tmp_path / "in.tif", SIZE, page=1).strokes
    np.testing.assert_array_equal(raster[4:10, 7:16], layer)
    assert raster[..., 3].astype(bool).sum() == layer[..., 3].astype(bool).sum()


@pytest.mark.parametrize("x, y", [(7, 4), (-3, 4), (28, 20), (100, 100)])
def test_a_cropped_layer_is_placed_and_not_stretched(tmp_path: Path, x: int, y: int) -> None:
    layer = scene(6, 9, channels=4)
    layer[..., 3] = 255
    wanted = np.zeros((*SIZE, 4), np.uint8)
    for row in range(6):
        for column in range(9):
            if 0 <= y + row < SIZE[0] and 0 <= x + column < SIZE[1]:
                wanted[y + row, x + column] = layer[row, column]
    frame = struct.pack(">2I2i", SIZE[1], SIZE[0], x, y)
    for chunk in ((b"oFFs", struct.pack(">2iB", x, y, 0)), (b"caNv", frame)):
        Image.fromarray(layer).save(tmp_path / "s.png")
        with_chunks(tmp_path / "s.png", chunk)
        np.testing.assert_array_equal(read_strokes(tmp_path / "s.png", SIZE), wanted)


def test_a_canvas_of_any_size_is_bounded(tmp_path: Path) -> None:
    Image.fromarray(scene(channels=4)).save(tmp_path / "s.png")
    with_chunks(tmp_path / "s.png", (b"caNv", struct.pack(">2I2i", 10**9, 10**9, 0, 0)))
    with pytest.raises(InputError, match="canvas"):
        read_strokes(tmp_path / "s.png", SIZE)


# EXR and JSON


def test_an_exr_as_filters_leave_it_is_cleaned_and_counted(tmp_path: Path) -> None:
    import OpenEXR

    pixels = np.full((4, 5, 4), 0.5, np.float32)
    pixels[..., 3] = 1
    pixels[0, 0, 1], pixels[1, 1, 3], pixels[2, 2, 3] = -1e-6, 1.0005, -0.01
    OpenEXR.File({}, {"RGBA": pixels}).write(str(tmp_path / "s.exr"))
    drawing = read_drawing(tmp_path / "s.exr", (4, 5))
    assert drawing.strokes.min() == 0 and drawing.strokes[..., 3].max() == 1
    assert "in 2 pixels" in drawing.notices[0] and "in 1 pixels" in drawing.notices[1]


def test_a_deep_exr_is_called_deep(tmp_path: Path) -> None:
    import OpenEXR

    samples = np.empty((2, 3), object)
    for at in np.ndindex(2, 3):
        samples[at] = np.float32([0.5, 0.25])
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, dict.fromkeys("RGB", samples)).write(str(tmp_path / "s.exr"))
    with pytest.raises(InputError, match="deep EXR"):
        read_strokes(tmp_path / "s.exr", SIZE)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_json_as_windows_shells_write_it(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "s.json").write_bytes('[{"points": [[1, 2]], "width": 3}]\r\n'.encode(encoding))
    (stroke,) = read_strokes(tmp_path / "s.json", SIZE)
    assert stroke.width == 3


def test_a_size_of_one_pixel_fits_no_other_shape(tmp_path: Path) -> None:
    drawing = {"size": [1, 1], "strokes": [{"points": [[0.5, 0.5]], "width": 0.1}]}
    (tmp_path / "s.json").write_text(json.dumps(drawing))
    (stroke,) = read_strokes(tmp_path / "s.json", (400, 400))
    assert stroke.points == ((200.0, 200.0),)
    with pytest.raises(InputError, match="shapes differ"):
        read_strokes(tmp_path / "s.json", (400, 600))
