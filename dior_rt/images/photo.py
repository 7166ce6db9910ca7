"""Photos in and out of files: orientation, depth, colour, transparency and metadata survive the way through.

In: PNG, JPEG (MPO too), TIFF, WebP, GIF, BMP, JPEG 2000, AVIF and PPM. Out: PNG, JPEG, TIFF and WebP, by the
file's suffix. The orientation that EXIF asks for is carried out; the rest of EXIF is kept (see `metadata`).
16-bit grey and RGB stay 16-bit (see `deep`). An RGB profile is kept with its primaries and honoured in its
curve (see `profiles`); other colour spaces become 8-bit sRGB. JPEG and WebP hold 8 bits, so a 16-bit photo is
rounded when it is written as such.
"""

from __future__ import annotations

import json
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
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from dior_rt.errors import InputError
from dior_rt.files import check_readable, check_writable, reason, replacing
from dior_rt.images.icc import Coloured, Curves, Pixels, convert_to_srgb, interpret, srgb_profile
from dior_rt.images.metadata import DAMAGE, KEY, keep_exif, read_dpi, stamp
from dior_rt.images.sixteen_bit import STRATEGY, is_deep, read_deep, write_png, write_tiff

#: Larger pictures are refused by their header, before they are decoded; Pillow, as it comes, agrees.
MOST_PIXELS = 178_956_970

_READABLE = ("PNG", "JPEG", "TIFF", "WEBP", "GIF", "BMP", "JPEG2000", "AVIF", "PPM")
_WRITABLE = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF", ".webp": "WEBP"}
_LONGEST = {"JPEG": 65500, "WEBP": 16383}
_SAVE: dict[str, dict[str, Any]] = {
    "JPEG": {"quality": 95, "subsampling": 0},
    "WEBP": {"quality": 95, "exact": True},
}

# EXIF's orientations but the first, each as what makes the picture stand upright.
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

    pixels: (H, W, 3) uint8 or uint16 on the sRGB curve, in the photo's own primaries. alpha: (H, W) of the
    file's depth, or None. curves: what the pixels are taken back to when written, where that is not sRGB's
    curve. icc, exif: as they are written, b"" for none. dpi: dots an inch across and down, or None. notices:
    sentences about what could not be kept.
    """

    pixels: Pixels
    alpha: Pixels | None = None
    curves: Curves | None = None
    icc: bytes = b""
    exif: bytes = b""
    dpi: tuple[float, float] | None = None
    notices: tuple[str, ...] = ()

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def bits(self) -> int:
        """8 or 16 a channel: the depth of the file, and of a file that keeps all of it."""
        codes = self.curves.srgb.shape[1] if self.curves else np.iinfo(self.pixels.dtype).max + 1
        return 8 if codes == 256 else 16

    def with_pixels(self, pixels: Pixels) -> Photo:
        """The same photo with other pixels of the same shape and dtype."""
        return replace(self, pixels=pixels)


def read_photo(path: Path, what: str = "photo") -> Photo:
    """Read a photo; what: how an error calls it.

    Raises InputError for a file that is missing, damaged, cut short, of more than MOST_PIXELS, or of a kind
    that cannot be kept whole (floating point, 32-bit integers).
    """
    check_readable(path, what)
    cause: BaseException
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's doubts about EXIF and size; both are dealt with here
            return _read(file)
    except UnidentifiedImageError as error:
        cause, problem = error, _kind_of(path)
    except Image.DecompressionBombError as error:
        cause, problem = error, f"it has more than {MOST_PIXELS // 10**6} megapixels"
    except MemoryError as error:
        cause, problem = error, "it does not fit into memory"
    except DAMAGE as error:
        cause, problem = error, reason(error)
    raise InputError(f"Cannot read the {what} {path}: {problem}.") from cause


def check_output(path: Path, photo: Photo) -> None:
    """Raise InputError where `write_photo(path, photo)` would fail: to be known before the work is done."""
    form = _form(path)
    if form == "JPEG" and _is_transparent(photo):
        raise InputError(f"Cannot write {path}: JPEG cannot hold the photo's transparency; name a .png file.")
    if max(photo.size) > _LONGEST.get(form, max(photo.size)):
        raise InputError(
            f"Cannot write {path}: {form} holds {_LONGEST[form]} pixels a side; name a .png file."
        )
    check_writable(path)


def write_photo(path: Path, photo: Photo, settings: Mapping[str, Any]) -> None:
    """Write a photo whole or not at all, with the settings that made it as JSON in its metadata.

    They stand in a PNG's iTXt chunk "Dior", elsewhere in EXIF's UserComment as {"Dior": {...}}. Raises
    InputError where the file cannot be written.
    """
    form = _form(path)
    samples = _samples(photo, form)
    with replacing(path) as file:
        try:
            if form == "PNG":
                _write_png(file, samples, photo, settings)
            elif form == "TIFF":
                write_tiff(file, samples, _tiff_tags(photo, settings))
            else:
                exif = stamp(photo.exif, settings).tobytes()
                _save(file, samples, photo, exif, format=form, **_SAVE[form])
        except (ValueError, TypeError, ArithmeticError, MemoryError) as error:
            raise InputError(f"Cannot write {path}: {reason(error)}.") from error


def _read(file: IO[bytes]) -> Photo:
    def open_image() -> ImageFile.ImageFile:
        file.seek(0)
        return Image.open(file, formats=_READABLE)

    image = open_image()
    if image.width * image.height > MOST_PIXELS:
        raise Image.DecompressionBombError
    notices = []
    if image.format != "MPO" and getattr(image, "is_animated", False):
        notices.append("It has more than one frame; the first is used.")
    # Pillow finds a TIFF's EXIF in the open file, and a PNG's perhaps after the pixels.
    exif = image.getexif() if image.format != "PNG" else None
    if is_deep(image):
        alpha, coloured = _interpret_deep(read_deep(open_image), image.info)
    else:
        _refuse_unknown_depth(image)
        image.load()
        alpha, coloured = _interpret_image(image)
    exif = exif or image.getexif()
    try:
        kept = keep_exif(exif)
    except DAMAGE:
        kept = b""
        notices.append("Its EXIF data is damaged; it is left out.")
    photo = Photo(
        coloured.pixels,
        alpha,
        coloured.curves,
        coloured.icc,
        kept,
        read_dpi(image.info),
        (*notices, *coloured.notices),
    )
    return _upright(photo, exif.get(Base.Orientation, 1))


def _refuse_unknown_depth(image: Image.Image) -> None:
    """Raise ValueError where Pillow would cut samples down to 8 bits, or misread them."""
    if image.mode in ("I", "F"):
        raise ValueError("it has 32-bit or floating-point samples; save it as a 16-bit PNG or TIFF")
    planes = image.tag_v2.get(258, (1,)) if isinstance(image, TiffImagePlugin.TiffImageFile) else (1,)
    if max(planes) > 8 and image.mode != "CMYK":
        raise ValueError("its 16-bit samples are stored in an unusual way; save it as a 16-bit PNG")


def _interpret_image(image: Image.Image) -> tuple[Pixels | None, Coloured]:
    """(alpha, colours) of a decoded 8-bit picture of any mode."""
    icc = image.info.get("icc_profile") or b""
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


def _interpret_deep(samples: np.ndarray, info: Mapping[Any, Any]) -> tuple[Pixels | None, Coloured]:
    """(alpha, colours) of (H, W, 1..4) 16-bit samples."""
    alpha = None
    if samples.shape[-1] in (2, 4):
        samples, alpha = samples[..., :-1], samples[..., -1]
    elif (key := info.get("transparency")) is not None:  # one colour stands for "nothing here"
        alpha = np.where((samples == np.asarray(key)).all(axis=-1), 0, 65535).astype(np.uint16)
    return alpha, interpret(samples, info.get("icc_profile") or b"")


def _upright(photo: Photo, orientation: int) -> Photo:
    turn = _UPRIGHT.get(orientation, lambda a: a)
    pixels = np.ascontiguousarray(turn(photo.pixels))
    alpha = None if photo.alpha is None else np.ascontiguousarray(turn(photo.alpha))
    dpi = photo.dpi[::-1] if photo.dpi and orientation in (5, 6, 7, 8) else photo.dpi
    return replace(photo, pixels=pixels, alpha=alpha, dpi=dpi)


def _form(path: Path) -> str:
    if path.suffix.lower() not in _WRITABLE:
        raise InputError(f"Cannot write {path}: its name must end in {', '.join(_WRITABLE)}.")
    return _WRITABLE[path.suffix.lower()]


def _is_transparent(photo: Photo) -> bool:
    return photo.alpha is not None and bool(photo.alpha.min() < np.iinfo(photo.alpha.dtype).max)


def _samples(photo: Photo, form: str) -> Pixels:
    """(H, W, 3 or 4) in the photo's own encoding, at the depth that the file will have."""
    bits = photo.bits if form in ("PNG", "TIFF") else 8
    pixels = photo.curves.from_srgb(photo.pixels) if photo.curves else photo.pixels
    pixels = _to_depth(pixels, bits)
    if photo.alpha is None or form == "JPEG":
        return pixels
    return np.concatenate([pixels, _to_depth(photo.alpha, bits)[..., None]], axis=-1)


def _to_depth(samples: Pixels, bits: int) -> Pixels:
    if samples.dtype == np.uint16 and bits == 8:
        return np.round(samples / 257).astype(np.uint8)
    return samples


def _save(file: IO[bytes], samples: Pixels, photo: Photo, exif: bytes, **options: Any) -> None:
    optional: dict[str, Any] = {"dpi": photo.dpi, "icc_profile": photo.icc, "exif": exif}
    given = {name: value for name, value in optional.items() if value}
    Image.fromarray(samples).save(file, **given, **options)


def _write_png(file: IO[bytes], samples: Pixels, photo: Photo, settings: Mapping[str, Any]) -> None:
    info = PngImagePlugin.PngInfo()
    if samples.dtype == np.uint8:
        info.add_itxt(KEY, json.dumps(settings))
        return _save(file, samples, photo, photo.exif, format="PNG", pnginfo=info, compress_type=STRATEGY)
    if photo.icc:
        info.add(b"iCCP", b"ICC profile\0\0" + zlib.compress(photo.icc))
    if photo.dpi:
        info.add(b"pHYs", struct.pack(">2IB", *(round(dots / 0.0254) for dots in photo.dpi), 1))
    if photo.exif:
        info.add(b"eXIf", photo.exif.removeprefix(b"Exif\0\0"))
    info.add_itxt(KEY, json.dumps(settings))
    write_png(file, samples, info)


def _tiff_tags(photo: Photo, settings: Mapping[str, Any]) -> ImageFileDirectory_v2:
    exif = stamp(photo.exif, settings)
    tags = ImageFileDirectory_v2()
    for tag, value in exif.items():
        tags[tag] = value
    for ifd in (IFD.Exif, IFD.GPSInfo):
        if values := exif.get_ifd(ifd):
            tags[ifd] = values
    if photo.icc:
        tags[34675] = photo.icc
    if photo.dpi:
        tags[282], tags[283], tags[296] = *photo.dpi, 2  # dots an inch
    return tags


def _kind_of(path: Path) -> str:
    """Why Pillow does not know the file, as the end of a sentence."""
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        return "it is empty"
    if head[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftypmsf1", b"ftyphevc"):
        return "it is a HEIC picture; save it as JPEG or PNG first"
    return "it is not a picture of a known kind (PNG, JPEG, TIFF, WebP ...), or it is damaged"
