"""Write the settings and the origin of the result into the photo's XMP packet.

ISO 16684-1. The origin is IPTC's DigitalSourceType. From it, a viewer can state that a model contributed to
the picture.
"""

from __future__ import annotations

from xml.dom import minidom
from xml.parsers.expat import ExpatError

MOST_BYTES = 1 << 20

_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_META = "adobe:ns:meta/"
_TIFF = "http://ns.adobe.com/tiff/1.0/"
_EXIF = "http://ns.adobe.com/exif/1.0/"
_XMP = "http://ns.adobe.com/xap/1.0/"
_NOTE = "http://ns.adobe.com/xmp/note/"
_IPTC = "http://iptc.org/std/Iptc4xmpExt/2008-02-29/"
_DIOR = "urn:dior-rt:1.0:"
SOURCE_TYPE = "http://cv.iptc.org/newscodes/digitalsourcetype/compositeWithTrainedAlgorithmicMedia"

#: Properties that are no longer true of the result, or that are written anew.
_STALE = {
    (_TIFF, "Orientation"),
    (_TIFF, "ImageWidth"),
    (_TIFF, "ImageLength"),
    (_EXIF, "PixelXDimension"),
    (_EXIF, "PixelYDimension"),
    (_XMP, "Thumbnails"),
    (_NOTE, "HasExtendedXMP"),
    (_IPTC, "DigitalSourceType"),
    (_DIOR, "settings"),
}

_EMPTY = f'<x:xmpmeta xmlns:x="{_META}"><rdf:RDF xmlns:rdf="{_RDF}"/></x:xmpmeta>'
_HEAD = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
_TAIL = '<?xpacket end="w"?>'


def is_sound(packet: bytes) -> bool:
    """Return whether a packet can be carried over."""
    try:
        _parse(packet)
    except ValueError:
        return False
    return True


def merge(packet: bytes, settings: str, generated: bool) -> bytes:
    """Return a packet (b"" for none) with the settings as text, and with the origin where it was generated.

    Raises ValueError for a damaged packet.
    """
    document, rdf = _parse(packet or _EMPTY.encode())
    for element in list(rdf.getElementsByTagName("*")):
        _drop_stale(element)
    description = document.createElementNS(_RDF, "rdf:Description")
    description.setAttribute("xmlns:rdf", _RDF)
    description.setAttributeNS(_RDF, "rdf:about", "")
    description.setAttribute("xmlns:dior", _DIOR)
    description.setAttributeNS(_DIOR, "dior:settings", settings)
    if generated:
        description.setAttribute("xmlns:Iptc4xmpExt", _IPTC)
        description.setAttributeNS(_IPTC, "Iptc4xmpExt:DigitalSourceType", SOURCE_TYPE)
    rdf.appendChild(description)
    assert document.documentElement is not None  # the packet holds rdf:RDF
    return f"{_HEAD}{document.documentElement.toxml()}{_TAIL}".encode()


def read_settings(packet: bytes) -> str:
    """Return the settings that `merge` wrote. Raises ValueError where there are none."""
    _, rdf = _parse(packet)
    for element in rdf.getElementsByTagName("*"):
        if element.hasAttributeNS(_DIOR, "settings"):
            return element.getAttributeNS(_DIOR, "settings")
    raise ValueError("it has no settings")


def _parse(packet: bytes) -> tuple[minidom.Document, minidom.Element]:
    """Return the document and its rdf:RDF. Raises ValueError."""
    if len(packet) > MOST_BYTES:
        raise ValueError("the XMP is too long")
    text = packet.strip(b"\0 \t\r\n")
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:  # a sound packet declares no entities here
        raise ValueError("the XMP is damaged")
    try:
        document = minidom.parseString(text)
    except (ExpatError, ValueError, LookupError, RecursionError) as error:
        raise ValueError("the XMP is damaged") from error
    found = document.getElementsByTagNameNS(_RDF, "RDF")
    if not found:
        raise ValueError("the XMP is damaged")
    return document, found[0]


def _drop_stale(element: minidom.Element) -> None:
    if (element.namespaceURI, element.localName) in _STALE and element.parentNode is not None:
        element.parentNode.removeChild(element)
        return
    for namespace, name in _STALE:
        if element.hasAttributeNS(namespace, name):
            element.removeAttributeNS(namespace, name)
