"""Write XMP beside a picture, for programs that read sidecars and for formats that hold no metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dior_rt.files import replacing
from dior_rt.images import xmp
from dior_rt.images.photo import Photo


def sidecar_path(picture: Path) -> Path:
    """Return the path of a picture's sidecar: a.xmp for a.png."""
    return picture.with_suffix(".xmp")


def write_sidecar(picture: Path, photo: Photo, settings: Mapping[str, Any]) -> None:
    """Write the sidecar of a result: the photo's XMP, and the settings. Raises InputError."""
    with replacing(sidecar_path(picture)) as file:
        file.write(xmp.merge(photo.xmp, json.dumps(settings), True))
