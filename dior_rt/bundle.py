"""The bundle: a folder with manifest.json and ONNX files, which holds everything needed to run one model.

docs/bundle.md describes the format. Reading checks the whole of it; writing shows all of it or nothing.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal

from dior_rt.errors import BundleError
from dior_rt.files import reason
from dior_rt.flow.schedule import DynamicShiftSchedule, ShiftSchedule
from dior_rt.grid import GridRule
from dior_rt.records import parse, read_json, unparse

FORMAT: Final = 2
MANIFEST = "manifest.json"
MOST_MANIFEST_BYTES = 1 << 20
MOST_STEPS = 1000
#: The constant entries of manifest.json that format 2 requires. No code depends on them.
CONSTANTS: Final[dict[str, Any]] = {"colour": "srgb", "settings": {}}


@dataclass(frozen=True)
class Tensor:
    """An input or output of a graph: dtype by NumPy's name, shape with a str for a side that may vary."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]


@dataclass(frozen=True)
class Graph:
    """One ONNX graph: its file in the bundle, and its tensors in the order of the graph.

    probe: an .npz in the bundle with one set of inputs and torch's outputs for them, by the tensors' names.
    Every device is tested against it.
    """

    file: str
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    probe: str | None = None


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The content of manifest.json. Raises ValueError for values that no bundle can have.

    precision: how the weights are stored ("fp32", "fp16", "int4" ...).
    files: relative path -> sha256 in hex, filled in by `write_bundle`.
    steps, guidance: what is used where the caller names nothing.
    grid: the size rule, for families that predict on a light grid.
    noise_scale: standard deviation of the starting noise; 1 draws from the posterior, 0 starts at the mean.
    parity: figures measured at export.
    """

    format: Literal[2] = FORMAT
    family: str
    name: str
    licence: str
    precision: str
    files: dict[str, str]
    graphs: dict[str, Graph]
    schedule: ShiftSchedule | DynamicShiftSchedule
    steps: int
    guidance: float
    grid: GridRule | None
    noise_scale: float
    parity: dict[str, float]

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= MOST_STEPS:
            raise ValueError(f"steps must lie between 1 and {MOST_STEPS}, not {self.steps}")
        for name, value in (("guidance", self.guidance), ("noise_scale", self.noise_scale)):
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be a number of at least 0, not {value}")
        if self.grid and not (self.grid.cells >= 1 and 1 <= self.grid.multiple <= self.grid.longest):
            raise ValueError("grid needs cells >= 1 and 1 <= multiple <= longest")
        for path in (*self.files, *self.graph_files()):
            _check_relative(path)
        for digest in self.files.values():
            if not re.fullmatch("[0-9a-f]{64}", digest):
                raise ValueError(f"{digest[:80]!r} is no sha256")

    def graph_files(self) -> list[str]:
        """Return the files that the graphs name."""
        return [file for graph in self.graphs.values() for file in (graph.file, graph.probe) if file]


@dataclass(frozen=True)
class Bundle:
    """A bundle on disk whose files were all found unaltered."""

    folder: Path
    manifest: Manifest

    @property
    def sha256(self) -> str:
        """Return the bundle's identity: the hash of its manifest, which holds the hashes of its files."""
        return _sha256(self.folder / MANIFEST)

    def path(self, graph: str) -> Path:
        """Return the path of the ONNX file of a graph, by the graph's name.

        Raises BundleError where there is none.
        """
        if graph not in self.manifest.graphs:
            raise BundleError(f"The bundle {self.folder} has no graph {graph!r}; export it again.")
        return self.folder / self.manifest.graphs[graph].file


def default_bundle() -> Path:
    """Return the folder of the bundle in this package. Raises BundleError where the installation lacks it."""
    folder = resources.files("dior_rt") / "bundles" / "mini"
    if not isinstance(folder, Path) or not folder.is_dir():
        raise BundleError("This installation has no model in it; reinstall dior-rt, or name a bundle.")
    return folder


def read_bundle(folder: Path) -> Bundle:
    """Read a bundle, and check its manifest's form and the sha256 of every file.

    Raises BundleError for a folder that is missing, altered, incomplete, of an unknown version or family, or
    whose manifest names a path outside the folder.
    """
    manifest = _read_manifest(folder)
    if unlisted := set(manifest.graph_files()) - manifest.files.keys():
        raise BundleError(f"The bundle {folder} names no sha256 for its file {min(unlisted)!r}.")
    for relative, digest in manifest.files.items():
        _check_file(folder, relative, digest)
    return Bundle(folder, manifest)


def write_bundle(
    folder: Path, manifest: Manifest, files: Mapping[str, Path], *, overwrite: bool = False
) -> Bundle:
    """Write a bundle atomically: `folder` never holds one that is incomplete or unchecked.

    files: relative path in the bundle -> the file to put there (linked where the file system can, else
    copied). The manifest's `files` are filled in from them. An existing bundle is replaced only with
    overwrite=True, and stays until the new one is ready. Raises BundleError.
    """
    folder = folder.resolve()
    try:
        check_target(folder, overwrite)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            draft = Path(scratch) / "bundle"
            draft.mkdir()
            written = _fill(draft, manifest, files)
            read_bundle(draft)
            _move_into_place(draft, folder)
    except (OSError, ValueError) as error:
        raise BundleError(f"Cannot write the bundle {folder}: {reason(error)}.") from error
    return Bundle(folder, written)


def check_target(folder: Path, overwrite: bool) -> None:
    """Raise BundleError where `write_bundle` would refuse the place because it may not replace what is
    there.
    """
    if not folder.exists() and not folder.is_symlink():
        return
    if not overwrite:
        raise BundleError(f"{folder} is there already; name another place, or ask to overwrite it.")
    if not (folder.is_dir() and (folder / MANIFEST).is_file()):
        raise BundleError(f"{folder} is no bundle, and only a bundle is overwritten.")


def _read_manifest(folder: Path) -> Manifest:
    if not folder.is_dir():
        raise BundleError(f"There is no bundle at {folder}.")
    try:
        document = read_json(folder / MANIFEST, MOST_MANIFEST_BYTES)
        version = document.get("format") if isinstance(document, dict) else None
        if type(version) is int and version != FORMAT:
            way = "update dior-rt" if version > FORMAT else "export its model again"
            raise ValueError(f"it has format {version}, and this dior-rt reads {FORMAT}: {way}")
        return parse(Manifest, _without_constants(document))
    except FileNotFoundError:
        raise BundleError(f"{folder} is no bundle: it has no {MANIFEST}.") from None
    except (OSError, ValueError) as error:
        raise BundleError(f"Cannot read {folder / MANIFEST}: {reason(error)}.") from error


def _to_document(manifest: Manifest) -> dict[str, Any]:
    """Return the manifest as JSON data, with the constants at the places where format 2 has them."""
    document = unparse(manifest)
    assert isinstance(document, dict)
    before_grid = list(document).index("grid")
    items = list(document.items())
    items.insert(before_grid, ("colour", CONSTANTS["colour"]))
    return dict(items) | {"settings": CONSTANTS["settings"]}


def _without_constants(document: Any) -> Any:
    """Return the JSON data without the constants. Raises ValueError where one has another value."""
    if not isinstance(document, dict):
        return document
    for name, value in CONSTANTS.items():
        if document.get(name, value) != value:
            raise ValueError(f"{name} must be {json.dumps(value)}")
    return {name: value for name, value in document.items() if name not in CONSTANTS}


def _check_relative(path: str) -> None:
    """Raise ValueError unless the path is in normal form and stays in its folder on every operating
    system.
    """
    plain = PurePosixPath(path)
    if str(plain) != path or plain.is_absolute() or ".." in plain.parts or set(path) & set("\\:\0"):
        raise ValueError(f"{path!r} is no path inside the bundle")
    if path in (".", MANIFEST):
        raise ValueError(f"{path!r} is no name for a file of a bundle")


def _check_file(folder: Path, relative: str, digest: str) -> None:
    path = folder / relative
    try:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise BundleError(f"The bundle {folder} names {relative!r}, which lies outside of it.")
        if not path.is_file():
            raise BundleError(f"The bundle {folder} lacks its file {relative!r}; fetch or export it again.")
        if _sha256(path) != digest:
            raise BundleError(f"The bundle {folder} was altered: {relative!r} does not match its sha256.")
    except (OSError, ValueError) as error:
        raise BundleError(f"Cannot read {path}: {reason(error)}.") from error


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _fill(draft: Path, manifest: Manifest, files: Mapping[str, Path]) -> Manifest:
    digests = {}
    for relative, source in sorted(files.items()):
        _check_relative(relative)
        path = draft / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source.resolve(), path)
        except OSError:  # another file system, or one without hard links
            shutil.copyfile(source, path)
        digests[relative] = _sha256(path)
    written = replace(manifest, files=digests)
    text = json.dumps(_to_document(written), indent=2, allow_nan=False)
    (draft / MANIFEST).write_text(text + "\n", encoding="utf-8")
    return written


def _move_into_place(draft: Path, folder: Path) -> None:
    if not folder.exists():
        draft.rename(folder)
    elif not _exchange(draft, folder):
        # Where the folders cannot be exchanged, the old bundle is moved aside, and moved back if the new one
        # cannot take its place.
        old = draft.with_name("old")
        folder.rename(old)
        try:
            draft.rename(folder)
        except OSError:
            old.rename(folder)
            raise


def _exchange(a: Path, b: Path) -> bool:
    """Swap two folders in one step, with Linux' renameat2. Returns False where the system cannot."""
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    at_working_folder, exchange = -100, 2
    return renameat2(at_working_folder, os.fsencode(a), at_working_folder, os.fsencode(b), exchange) == 0
