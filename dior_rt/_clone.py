"""Find `dior_rt.kernels`, `dior_rt.export` and `dior_rt.training` in a clone of the repository.

The three packages lie beside `dior_rt/` in a clone and inside it once installed. Python started in the
clone's root imports the clone's `dior_rt` even where another copy is installed, so the clone must find its
own parts.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

INSIDE = Path(__file__).resolve().parent
PARTS = ("kernels", "export", "training")


class PartFinder(MetaPathFinder):
    """Find `dior_rt.NAME` in the folder NAME beside `dior_rt/`."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of one of PARTS; submodules are then found by Python's own finder."""
        package, _, name = fullname.partition(".")
        if package != "dior_rt" or name not in PARTS:
            return None
        folder = INSIDE.parent / name
        return spec_from_file_location(
            fullname, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )


def install() -> None:
    """Add the finder, if the parts lie beside `dior_rt/` and not inside it."""
    beside = all((INSIDE.parent / name / "__init__.py").is_file() for name in PARTS)
    inside = any((INSIDE / name).is_dir() for name in PARTS)
    if beside and not inside and not any(isinstance(finder, PartFinder) for finder in sys.meta_path):
        sys.meta_path.append(PartFinder())
