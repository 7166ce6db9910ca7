"""Recognise camera raw files by their first bytes. Their pictures must be developed before they are relit."""

from __future__ import annotations

RAW = (
    "it is a camera raw file, which must be developed first: save it as a 16-bit TIFF from a raw converter, "
    "or pip install 'dior-rt[raw]'"
)

_MAGIC = (
    (0, b"FUJIFILMCCD-RAW"),
    (0, b"IIRO"),  # Olympus
    (0, b"IIRS"),
    (0, b"MMOR"),
    (0, b"IIU\0"),  # Panasonic
    (0, b"FOVb"),  # Sigma
    (0, b"\0MRM"),  # Minolta
    (6, b"HEAPCCDR"),  # Canon, CRW
    (8, b"CR\x02"),  # Canon, CR2
    (8, b"IIII"),  # Phase One
    (4, b"ftypcrx "),  # Canon, CR3
)


def is_raw(head: bytes) -> bool:
    """Return whether a file that begins like this is a camera's raw file.

    DNG and NEF are recognised by their tags.
    """
    return any(head[at : at + len(magic)] == magic for at, magic in _MAGIC)
