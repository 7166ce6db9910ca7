"""Make the asset folder from furniture archives and a folder of surfaces and panoramas."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from dior_rt.errors import InputError
from dior_rt.files import make_folder, reason, replacing
from dior_rt.training.blender.assets import Assets, Entry, save_model
from dior_rt.training.blender.furniture import find_catalogues, models
from dior_rt.training.blender.people import make_person

COLLECTIONS = {
    "BlendSwap-CC-0": "models by various authors of blendswap.com, CC0 1.0",
    "BlendSwap-CC-BY": "models by various authors of blendswap.com, CC BY 3.0",
    "KatorLegaz": "models by Andrew Kator and Jennifer Legaz, CC BY 3.0",
    "Reallusion": "models by Reallusion, CC BY 3.0",
    "Scopia": "models by Scopia and Emmanuel Puybaret / eTeks, CC BY 3.0",
}


def make_assets(
    out: Path, furniture: Path, data: Path, progress: Callable[[str], None] = lambda name: None
) -> list[Entry]:
    """Fill the asset folder `out`. Raises InputError where a source is missing or nothing can be written.

    furniture: holds the .sh3f archives of Debian's sweethome3d-furniture
    (/usr/share/sweethome3d/furniture), or folders of them. data: holds surfaces/ and panoramas/.
    """
    catalogues = find_catalogues(furniture)
    for part in ("surfaces", "panoramas"):
        if not (data / part).is_dir():
            raise InputError(f"{data} holds no folder {part}.")
    make_folder(out / "models")
    entries: list[Entry] = []
    for catalogue in catalogues:
        progress(catalogue.name)
        for model in models(catalogue):
            save_model(out / model.entry.file, model.mesh)
            entries.append(model.entry)
    for part in ("surfaces", "panoramas"):
        try:
            shutil.copytree(data / part, out / part, dirs_exist_ok=True, copy_function=shutil.copyfile)
        except OSError as error:
            raise InputError(f"Cannot copy {data / part}: {reason(error)}.") from error
    write_entries(out, entries)
    return entries


def add_people(out: Path, count: int, progress: Callable[[str], None] = lambda name: None) -> list[Entry]:
    """Bring the number of people in an asset folder to `count`. Existing ones stay. Raises InputError."""
    assets = Assets.open(out)
    make_folder(out / "people")
    entries = {entry.file: entry for entry in assets.entries}
    there = sum(file.startswith("people/") for file in entries)
    for seed in range(there, count):
        entry, mesh = make_person(seed, assets)
        save_model(out / entry.file, mesh)
        entries[entry.file] = entry
        progress(entry.file)
    write_entries(out, list(entries.values()))
    return list(entries.values())


def write_entries(out: Path, entries: list[Entry]) -> None:
    """Write models.json and ATTRIBUTION.md."""
    with replacing(out / "models.json") as file:
        file.write(json.dumps([asdict(entry) for entry in entries], indent=0).encode())
    with replacing(out / "ATTRIBUTION.md") as file:
        file.write(attribution(entries).encode())


def attribution(entries: list[Entry]) -> str:
    """Return a text that names every model with its author and licence, as CC BY requires."""
    lines = [
        "# Attribution",
        "",
        "Models from Sweet Home 3D's furniture libraries (www.sweethome3d.com), made smaller and converted.",
        "CC BY 3.0: creativecommons.org/licenses/by/3.0. CC0 1.0: creativecommons.org/publicdomain/zero/1.0.",
        "",
        *(f"- {name}: {what}" for name, what in COLLECTIONS.items()),
        "",
        "Surfaces: ambientCG (CC0 1.0). Panoramas: Poly Haven (CC0 1.0).",
        "People: MakeHuman's base mesh (CC0 1.0).",
        "",
        "| file | model | author | licence |",
        "|---|---|---|---|",
    ]
    rows = [f"| {entry.file} | {entry.name} | {entry.author} | {entry.licence} |" for entry in entries]
    return "\n".join([*lines, *rows, ""])
