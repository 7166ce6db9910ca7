"""The photos that Pillow does not read: the module that reads each kind, and the extra that it needs.

A reader is a module of this package with `read(path) -> Photo`. It is imported when a file of its kind is
read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from dior_rt.images.photo import Photo

HEIF_BRANDS: Final = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
RAW_SUFFIXES: Final = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2", ".pef"),
    *(".srw", ".3fr", ".fff", ".iiq", ".mrw", ".x3f", ".erf", ".kdc", ".dcr", ".mos", ".rwl"),
)


class MissingReader(Exception):  # noqa: N818 - it ends as part of an InputError
    """A reader's extra is not installed. The error's text names it, as the end of a sentence."""


@dataclass(frozen=True)
class Reader:
    """A reader of one kind of file.

    module: its name in dior_rt.images. kind: the kind's name for users. extra: the extra that installs its
    library, or None for none. fits: whether a file with these first bytes and this suffix is of the kind.
    """

    module: str
    kind: str
    extra: str | None
    fits: Callable[[bytes, str], bool]

    def load(self) -> Callable[[Path], Photo]:
        """Return the module's `read`. Raises MissingReader where its extra is not installed."""
        try:
            return import_module(f"dior_rt.images.{self.module}").read
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] == "dior_rt":
                raise
            raise MissingReader(
                f"it is {self.kind}, which needs one more package: pip install 'dior-rt[{self.extra}]'"
            ) from error


def _is_heif(head: bytes, suffix: str) -> bool:
    return head[4:8] == b"ftyp" and head[8:12] in HEIF_BRANDS


def _is_jxl(head: bytes, suffix: str) -> bool:
    return head.startswith((b"\xff\x0a", b"\0\0\0\x0cJXL \r\n\x87\n"))


def _is_exr(head: bytes, suffix: str) -> bool:
    return head.startswith(b"\x76\x2f\x31\x01")


def _is_raw(head: bytes, suffix: str) -> bool:
    from dior_rt.images.camera_raw import is_raw

    return is_raw(head) or (suffix in RAW_SUFFIXES and head[:4] in (b"II*\0", b"MM\0*"))


READERS: Final = (
    Reader("exr_photo", "an OpenEXR picture", None, _is_exr),
    Reader("heif", "a HEIC picture", "heic", _is_heif),
    Reader("jxl", "a JPEG XL picture", "jxl", _is_jxl),
    Reader("raw", "a camera raw file", "raw", _is_raw),
)


def default_form(photo: Path) -> str:
    """Return the suffix of a result that keeps the photo's data: "tif" for raw, "exr" for EXR, else "png"."""
    suffix = photo.suffix.lower()
    return "exr" if suffix == ".exr" else "tif" if suffix in RAW_SUFFIXES else "png"


def find_reader(head: bytes, suffix: str) -> Reader | None:
    """Return the reader of a file with these first bytes, or None where Pillow reads it or no reader fits."""
    return next((reader for reader in READERS if reader.fits(head, suffix.lower())), None)
