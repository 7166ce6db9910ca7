"""Read and write photos: orientation, depth, colour, transparency and metadata are preserved.

In: PNG, JPEG (MPO too), TIFF, WebP, GIF, BMP, JPEG 2000, AVIF, PPM and flat Photoshop documents, and what
`readers` adds: EXR, HEIC, JPEG XL and camera raw. Out: PNG, JPEG, TIFF, WebP, EXR and JPEG XL, by the file's
suffix. The orientation that EXIF asks for is carried out; the rest of EXIF is kept (see `metadata`).
16-bit grey and RGB stay 16-bit (see `sixteen_bit`). An RGB profile is kept with its primaries and honoured in
its curve (see `icc`); what PNG, AVIF and EXIF say of colour in other ways becomes such a profile
(`primaries`); other colour spaces become 8-bit sRGB. JPEG and WebP hold 8 bits, so a 16-bit photo is
rounded when it is written as such.
"""

from __future__ import annotations

import json
import shutil
import struct
import warnings
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from PIL import Image, ImageFile, PngImagePlugin, TiffImagePlugin, UnidentifiedImageError

from dior_rt.errors import InputError
from dior_rt.files import check_readable, check_writable, reason, replacing
from dior_rt.images import xmp
from dior_rt.images.camera_raw import RAW, is_raw
from dior_rt.images.containers import facts_of, read_facts
from dior_rt.images.directories import BYTE, RATIONAL, SHORT, UNDEFINED, entry
from dior_rt.images.encoding import BITS, PLAIN, Encoding
from dior_rt.images.icc import (
    Coloured,
    Curves,
    Pixels,
    convert_to_srgb,
    interpret,
    read_primaries,
    srgb_profile,
)
from dior_rt.images.metadata import (
    DAMAGE,
    IPTC_TAG,
    KEY,
    XMP_TAG,
    directories_of,
    photoshop_block,
    read_dpi,
)
from dior_rt.images.netpbm import is_deep_netpbm, read_netpbm
from dior_rt.images.png_chunks import raw_profile
from dior_rt.images.primaries import Matrix, conversion, srgb
from dior_rt.images.readers import MissingReader, find_reader
from dior_rt.images.sixteen_bit import STRATEGY, is_deep, read_deep, write_png, write_tiff
from dior_rt.images.tiff_pages import read_facts as read_tiff_facts

#: Larger pictures are refused by their header, before they are decoded. Pillow's default limit agrees.
MOST_PIXELS = 178_956_970

_READABLE = ("PNG", "JPEG", "TIFF", "WEBP", "GIF", "BMP", "JPEG2000", "AVIF", "PPM", "PSD")
_WRITABLE = {
    ".png": "PNG",
    ".jpg": "JPEG",
    ".jpeg": "JPEG",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".webp": "WEBP",
    ".exr": "EXR",
    ".jxl": "JXL",
}
_TIFF_HEADS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_JPEG_SEGMENT = 65533
_LONGEST = {"JPEG": 65500, "WEBP": 16383}
_SAVE: dict[str, dict[str, Any]] = {
    "JPEG": {"quality": 95, "subsampling": 0},
    "WEBP": {"quality": 95, "exact": True},
}

# EXIF's orientations except the first, each as the operation that turns the picture upright.
_UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: np.fliplr,
    3: partial(np.rot90, k=2),
    4: np.flipud,
    5: partial(np.swapaxes, axis1=0, axis2=1),
    6: partial(np.rot90, k=-1),
    7: lambda a: np.rot90(np.swapaxes(a, 0, 1), 2),
    8: np.rot90,
}


@dataclass(frozen=True)
class Photo:
    """A photo as it is seen, upright.

    pixels: (H, W, 3) uint8 or uint16 on the sRGB curve, in the photo's own primaries; or float32 on that
    curve, continued above 1 (see `exr_photo`). alpha: (H, W) at the file's depth, or None. curves: the curves
    that the pixels are taken back to when written, where they differ from sRGB's. icc, exif, xmp, iptc: the
    bytes to write, b"" for none. dpi: dots per inch across and down, or None. notices: sentences about what
    could not be kept. offset, canvas: the place of a cut-out picture, (right, down) on a canvas of (rows,
    columns), None where the file names none. lossy: whether packing changed the pixels.
    """

    pixels: Pixels
    alpha: Pixels | None = None
    curves: Curves | None = None
    icc: bytes = b""
    exif: bytes = b""
    dpi: tuple[float, float] | None = None
    notices: tuple[str, ...] = ()
    xmp: bytes = b""
    iptc: bytes = b""
    offset: tuple[int, int] = (0, 0)
    canvas: tuple[int, int] | None = None
    lossy: bool = False
    pages: int = 1

    @property
    def primaries(self) -> Matrix:
        """Return (3, 3), the primaries for red, green and blue; those of sRGB where no profile names
        others.
        """
        found = read_primaries(self.icc) if self.icc else None
        return srgb() if found is None else found

    @property
    def size(self) -> tuple[int, int]:
        """Return (height, width) in pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def bits(self) -> int:
        """Return the bits per channel, 8, 16 or 32: the depth of the file, and of a file that keeps all of
        it.
        """
        if self.pixels.dtype == np.float32:
            return 32
        codes = self.curves.srgb.shape[1] if self.curves else np.iinfo(self.pixels.dtype).max + 1
        return 8 if codes == 256 else 16

    def with_bits(self, bits: int | None) -> Photo:
        """Return the photo with 16 bits per channel where it has 8 and more are requested.

        Its light is then computed at that depth.
        """
        if bits != 16 or self.bits != 8:
            return self
        wide = self.pixels if self.pixels.dtype == np.uint16 else self.pixels * np.uint16(257)
        alpha = None if self.alpha is None else self.alpha * np.uint16(257)
        return replace(self, pixels=wide, alpha=alpha, curves=self.curves and self.curves.with_codes(65536))

    def with_pixels(self, pixels: Pixels) -> Photo:
        """Return the same photo with other pixels of the same shape and dtype."""
        return replace(self, pixels=pixels)


def read_photo(path: Path, what: str = "photo", page: int = 0) -> Photo:
    """Read a photo. what: its name in errors. page: the index of the page in a file with several, from 0.

    Raises InputError for a file that is missing, damaged, cut short, larger than MOST_PIXELS, or of a kind
    that cannot be kept whole (camera raw, HDR, floating point, 32-bit integers).
    """
    check_readable(path, what)
    cause: BaseException
    reader = None
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns about EXIF and size; this function handles both
            if what == "photo" and (reader := find_reader(file.read(64), path.suffix)):
                return reader.load()(path)
            file.seek(0)
            return _read(file, page)
    except InputError:
        raise
    except UnidentifiedImageError as error:
        cause, problem = error, _kind_of(path)
    except Image.DecompressionBombError as error:
        cause, problem = error, f"it has more than {MOST_PIXELS // 10**6} megapixels"
    except MemoryError as error:
        cause, problem = error, "it does not fit into memory"
    except MissingReader as error:
        cause, problem = error, str(error)
    except DAMAGE as error:
        cause, problem = error, reason(error)
        if reader:
            problem = f"it is {reader.kind} that is damaged or of an unknown kind ({problem})"
    raise InputError(f"Cannot read the {what} {path}: {problem}.") from cause


def check_output(path: Path, photo: Photo, encoding: Encoding = PLAIN) -> None:
    """Raise InputError where `write_photo` would fail, so that the error comes before the work is done."""
    form = _form(path)
    if problem := encoding.problem(form):
        raise InputError(f"Cannot write {path}: {problem}.")
    if form == "EXR" and photo.icc and conversion(photo.primaries, srgb()) is not None:
        raise InputError(
            f"Cannot write {path}: EXR cannot keep the photo's colour profile; name a .tif file."
        )
    if form == "JXL":
        _jxl_writer(path)
    if form == "JPEG" and _is_transparent(photo):
        raise InputError(f"Cannot write {path}: JPEG cannot hold the photo's transparency; name a .png file.")
    if max(photo.size) > _LONGEST.get(form, max(photo.size)):
        raise InputError(
            f"Cannot write {path}: {form} holds {_LONGEST[form]} pixels a side; name a .png file."
        )
    check_writable(path)


def write_photo(
    path: Path,
    photo: Photo,
    settings: Mapping[str, Any],
    encoding: Encoding = PLAIN,
    *,
    generated: bool = True,
) -> tuple[str, ...]:
    """Write a photo whole or not at all, with the settings that made it as JSON in its metadata.

    The settings are stored in XMP, and in a PNG also in the iTXt chunk "Dior". generated: whether XMP states
    that a model contributed to the picture. Returns sentences about what the format cannot hold. Raises
    InputError where the file cannot be written.
    """
    form = _form(path)
    if form == "EXR":
        return _write_exr(path, photo, settings, encoding)
    samples = _samples(photo, form, encoding.bits)
    packet, iptc, notices = _metadata(photo, form, settings, generated)
    if photo.pixels.dtype == np.float32 and (photo.pixels > 1).any():
        notices = (*notices, f"{form} ends at display white; name an .exr file to keep brighter light.")
    if form == "JXL":
        return (*notices, *_write_jxl(path, samples, photo, encoding))
    quality = {} if encoding.quality is None else {"quality": encoding.quality}
    with replacing(path) as file:
        try:
            if form == "PNG":
                _write_png(file, samples, photo, settings, packet, iptc)
            elif form == "TIFF":
                _write_tiff(file, samples, photo, packet, iptc)
            else:
                more: dict[str, Any] = {"extra": photoshop_block(iptc)} if iptc else {}
                _save(file, samples, photo, format=form, xmp=packet, **more, **(_SAVE[form] | quality))
        except (ValueError, TypeError, ArithmeticError, MemoryError, struct.error) as error:
            raise InputError(f"Cannot write {path}: {reason(error)}.") from error
    return notices


def _read(file: IO[bytes], page: int) -> Photo:
    head = file.read(1024)
    if is_raw(head):
        raise ValueError(RAW)
    if head[:4] in _TIFF_HEADS:
        _refuse_unreadable_tiff(file, page)

    def open_image() -> ImageFile.ImageFile:
        file.seek(0)
        opened = Image.open(file, formats=_READABLE)
        if page:
            opened.seek(page)
        opened.info.pop("xmp", None)  # Pillow would turn a TIFF by it; only EXIF's orientation counts
        return opened

    file.seek(0)
    image = Image.open(file, formats=_READABLE)
    if image.width * image.height > MOST_PIXELS:
        raise Image.DecompressionBombError
    pages = 1 if image.format in ("MPO", "PSD") else getattr(image, "n_frames", 1)
    if page >= pages:
        raise ValueError(f"it has no page {page}; its pages are 0 to {pages - 1}")
    if page:
        image.seek(page)
    facts = read_facts(file, image, page)
    if image.format == "PSD":
        notices = ["It is a Photoshop document; its flat picture is read, without layers."]
    elif pages > 1:
        notices = [f"It has {pages} pages; page {page}{', the first,' * (not page)} is read."]
    else:
        notices = []
    if _has_gain_map(image):
        notices.append("It has an HDR gain map, which belongs to the photo's old light; it is left out.")
    notices += facts.notices
    image = open_image()
    if is_deep_netpbm(head):
        alpha, coloured = None, interpret(read_netpbm(file), facts.icc)
    elif is_deep(image):
        alpha, coloured = _interpret_deep(read_deep(open_image), image.info, facts.icc)
    else:
        _refuse_unknown_depth(image)
        image.load()
        alpha, coloured = interpret_image(image, facts.icc)
    if facts.bits:
        notices.append(
            f"It has {facts.bits} bits a channel, of which 8 are read; a 16-bit PNG or TIFF keeps them."
        )
    if facts.exif.damaged:
        notices.append("A part of its EXIF data is damaged; that part is left out.")
    xmp_kept = facts.xmp if facts.xmp and xmp.is_sound(facts.xmp) else b""
    if facts.xmp and not xmp_kept:
        notices.append("Its XMP data is damaged or too long; it is left out.")
    photo = Photo(
        coloured.pixels,
        alpha,
        coloured.curves,
        coloured.icc,
        facts.exif.kept(),
        read_dpi(image.info),
        (*notices, *coloured.notices),
        xmp_kept,
        facts.iptc,
        facts.offset,
        facts.canvas,
        facts.lossy,
        pages,
    )
    orientation = facts.exif.orientation
    if facts.turned:
        return replace(photo, dpi=_turned_dpi(photo.dpi, orientation))
    return upright(photo, orientation)


def _refuse_unreadable_tiff(file: IO[bytes], page: int) -> None:
    facts = read_tiff_facts(file, page)
    if facts.is_raw:
        raise ValueError(RAW)
    if facts.depth:
        raise ValueError(
            f"it has {facts.depth}; save it as a 16-bit RGB PNG or TIFF (light of any strength: as EXR)"
        )


def _refuse_unknown_depth(image: Image.Image) -> None:
    """Raise ValueError where Pillow would cut samples down to 8 bits, or misread them."""
    if image.mode in ("I", "F"):
        raise ValueError("it has 32-bit or floating-point samples; save it as a 16-bit PNG or TIFF")
    planes = image.tag_v2.get(258, (1,)) if isinstance(image, TiffImagePlugin.TiffImageFile) else (1,)
    if max(planes) > 8 and image.mode != "CMYK":
        raise ValueError("its 16-bit samples are stored in an unusual way; save it as a 16-bit PNG")


def interpret_image(image: Image.Image, icc: bytes) -> tuple[Pixels | None, Coloured]:
    """Return (alpha, colours) of a decoded 8-bit picture of any mode."""
    if image.mode == "CMYK":
        if icc[16:20] != b"CMYK":
            return None, Coloured(np.asarray(image.convert("RGB")))
        return None, Coloured(np.asarray(convert_to_srgb(image, icc)), icc=srgb_profile())
    grey = image.mode in ("1", "L", "LA", "La")
    transparent = image.has_transparency_data
    mode = ("L", "LA", "RGB", "RGBA")[2 * (not grey) + transparent]
    samples = np.asarray(image if image.mode == mode else image.convert(mode))
    samples = samples.reshape(*samples.shape[:2], len(mode))
    if transparent:
        return samples[..., -1], interpret(samples[..., :-1], icc)
    return None, interpret(samples, icc)


def _interpret_deep(
    samples: np.ndarray, info: Mapping[Any, Any], icc: bytes
) -> tuple[Pixels | None, Coloured]:
    """Return (alpha, colours) of (H, W, 1..4) 16-bit samples."""
    alpha = None
    if samples.shape[-1] in (2, 4):
        samples, alpha = samples[..., :-1], samples[..., -1]
    elif (key := info.get("transparency")) is not None:  # one colour stands for transparent pixels
        alpha = np.where((samples == np.asarray(key)).all(axis=-1), 0, 65535).astype(np.uint16)
    return alpha, interpret(samples, icc)


def photo_of(image: Image.Image) -> Photo:
    """Return the photo of an 8-bit Pillow image, as `read_photo` would read its file. Raises InputError."""
    try:
        image.load()
        facts = facts_of(image)
        alpha, coloured = interpret_image(image, facts.icc)
    except (*DAMAGE, MemoryError) as error:
        raise InputError(f"The image cannot be used: {reason(error)}.") from error
    photo = Photo(
        coloured.pixels, alpha, coloured.curves, coloured.icc, facts.exif.kept(), read_dpi(image.info)
    )
    return photo if facts.turned else upright(photo, facts.exif.orientation)


def image_of(photo: Photo, pixels: Pixels) -> Image.Image:
    """Return an 8-bit Pillow image: other pixels in the photo's encoding, with its alpha and metadata."""
    image = Image.fromarray(_samples(photo.with_pixels(pixels), "WEBP"))
    image.info = {name: value for name, value in _info(photo).items() if value}
    return image


def _info(photo: Photo) -> dict[str, Any]:
    return {"dpi": photo.dpi, "icc_profile": photo.icc, "exif": photo.exif}


def upright(photo: Photo, orientation: int) -> Photo:
    """Return the photo turned as EXIF's orientation requires."""
    turn = _UPRIGHT.get(orientation, lambda a: a)
    pixels = np.ascontiguousarray(turn(photo.pixels))
    alpha = None if photo.alpha is None else np.ascontiguousarray(turn(photo.alpha))
    return replace(photo, pixels=pixels, alpha=alpha, dpi=_turned_dpi(photo.dpi, orientation))


def _turned_dpi(dpi: tuple[float, float] | None, orientation: int) -> tuple[float, float] | None:
    return dpi[::-1] if dpi and orientation in (5, 6, 7, 8) else dpi


def _form(path: Path) -> str:
    if path.suffix.lower() not in _WRITABLE:
        raise InputError(f"Cannot write {path}: its name must end in {', '.join(_WRITABLE)}.")
    return _WRITABLE[path.suffix.lower()]


def _is_transparent(photo: Photo) -> bool:
    return photo.alpha is not None and bool(photo.alpha.min() < np.iinfo(photo.alpha.dtype).max)


def _samples(photo: Photo, form: str, bits: int | None = None) -> Pixels:
    """Return (H, W, 3 or 4) samples in the photo's encoding, at the depth that the file will have."""
    bits = bits or (min(photo.bits, 16) if 16 in BITS[form] else 8)
    pixels = photo.curves.from_srgb(photo.pixels) if photo.curves else photo.pixels
    pixels = _to_depth(pixels, bits)
    if photo.alpha is None or form == "JPEG":
        return pixels
    return np.concatenate([pixels, _to_depth(photo.alpha, bits)[..., None]], axis=-1)


def _to_depth(samples: Pixels, bits: int) -> Pixels:
    if samples.dtype == np.float32:
        top = (1 << bits) - 1
        return np.round(np.clip(samples, 0, 1) * np.float32(top)).astype(np.uint8 if bits == 8 else np.uint16)
    if samples.dtype == np.uint8 and bits == 16:
        return samples * np.uint16(257)
    if samples.dtype == np.uint16 and bits == 8:
        return np.round(samples / 257).astype(np.uint8)
    return samples


def _metadata(
    photo: Photo, form: str, settings: Mapping[str, Any], generated: bool
) -> tuple[bytes, bytes, tuple[str, ...]]:
    """Return XMP and IPTC as the format holds them, and sentences about what it does not hold."""
    text, iptc, notices = json.dumps(settings), photo.iptc, []
    packet = xmp.merge(photo.xmp, text, generated)
    if form == "JPEG" and len(packet) > _JPEG_SEGMENT - 29:
        notices.append("JPEG cannot hold XMP data of this length; the photo's own is left out.")
        packet = xmp.merge(b"", text, generated)
    if (form == "JPEG" and len(iptc) > _JPEG_SEGMENT - 30) or (form == "WEBP" and iptc):
        notices.append(f"{form} cannot hold the photo's IPTC data; it is left out.")
        iptc = b""
    return packet, iptc, tuple(notices)


def _save(file: IO[bytes], samples: Pixels, photo: Photo, **options: Any) -> None:
    given = {name: value for name, value in _info(photo).items() if value}
    Image.fromarray(samples).save(file, **given, **options)


def _write_png(
    file: IO[bytes], samples: Pixels, photo: Photo, settings: Mapping[str, Any], packet: bytes, iptc: bytes
) -> None:
    info = PngImagePlugin.PngInfo()
    info.add_itxt(KEY, json.dumps(settings))
    info.add_itxt("XML:com.adobe.xmp", packet.decode())
    if iptc:
        info.add_text("Raw profile type iptc", raw_profile("iptc", iptc).decode(), zip=True)
    if samples.dtype == np.uint8:
        return _save(file, samples, photo, format="PNG", pnginfo=info, compress_type=STRATEGY)
    if photo.icc:
        info.add(b"iCCP", b"ICC profile\0\0" + zlib.compress(photo.icc))
    if photo.dpi:
        info.add(b"pHYs", struct.pack(">2IB", *(round(dots / 0.0254) for dots in photo.dpi), 1))
    if photo.exif:
        info.add(b"eXIf", photo.exif.removeprefix(b"Exif\0\0"))
    write_png(file, samples, info)


def _write_tiff(file: IO[bytes], samples: Pixels, photo: Photo, packet: bytes, iptc: bytes) -> None:
    tags, children = directories_of(photo.exif)
    tags[XMP_TAG] = entry(BYTE, packet)
    if iptc:
        tags[IPTC_TAG] = entry(UNDEFINED, iptc)
    if photo.icc:
        tags[34675] = entry(UNDEFINED, photo.icc)
    if photo.dpi:
        tags[282], tags[283] = (entry(RATIONAL, dots) for dots in photo.dpi)
        tags[296] = entry(SHORT, 2)  # dots per inch
    write_tiff(file, samples, tags, children)


def _write_exr(path: Path, photo: Photo, settings: Mapping[str, Any], encoding: Encoding) -> tuple[str, ...]:
    from dior_rt.images.exr import write_exr
    from dior_rt.images.exr_photo import to_light

    light = to_light(photo)
    write_exr(path, light.astype(np.float16) if encoding.bits == 16 else light, {KEY: json.dumps(settings)})
    lost = [name for name, data in (("EXIF", photo.exif), ("XMP", photo.xmp), ("IPTC", photo.iptc)) if data]
    return (f"EXR cannot hold the photo's {' and '.join(lost)} data; it is left out.",) if lost else ()


def _jxl_writer(path: Path) -> Callable[[Path, Pixels, bytes, int | None], None]:
    try:
        from dior_rt.images.jxl import write
    except ModuleNotFoundError as error:
        raise InputError(
            f"Cannot write {path}: JPEG XL needs one more package: pip install 'dior-rt[jxl]'."
        ) from error
    return write


def _write_jxl(path: Path, samples: Pixels, photo: Photo, encoding: Encoding) -> tuple[str, ...]:
    write = _jxl_writer(path)
    with replacing(path) as file:
        draft = Path(file.name)
        named = draft.with_suffix(".jxl")  # the library chooses the format by the name
        try:
            write(named, samples, photo.icc, encoding.quality)
            with named.open("rb") as packed:
                shutil.copyfileobj(packed, file)
        except (ValueError, RuntimeError, MemoryError) as error:
            raise InputError(f"Cannot write {path}: {reason(error)}.") from error
        finally:
            named.unlink(missing_ok=True)
    return ("The JPEG XL file holds no metadata but its profile; --sidecar writes it beside the picture.",)


def _has_gain_map(image: Image.Image) -> bool:
    """Return whether a JPEG is marked as Ultra HDR, by its XMP or by ISO 21496-1."""
    if image.format not in ("JPEG", "MPO"):
        return False
    segments = [data for _, data in getattr(image, "applist", [])]
    return any(b"hdr-gain-map" in data or b"iso:ts:21496" in data for data in segments)


def _kind_of(path: Path) -> str:
    """Return why Pillow does not recognise the file, as the end of a sentence."""
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        return "it is empty"
    if head[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftypmsf1", b"ftyphevc"):
        return "it is a HEIC picture; save it as JPEG or PNG first"
    if head[:4] == b"8BPS":
        return (
            "it is a Photoshop document of a kind that is not read; save it as an 8-bit RGB one, or as TIFF"
        )
    return "it is not a picture of a known kind (PNG, JPEG, TIFF, WebP ...), or it is damaged"
