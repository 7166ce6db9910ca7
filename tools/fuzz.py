"""Feed damaged files to every reader, and count what is not one sentence.

    python -m tools.fuzz --count 100000 --seed 1

An input is a sound file with some bytes changed, cut, doubled or removed. It must be read, or refused with
a DiorError of one line, within ten seconds of the processor, and leave no file behind. Input number N of a
kind is the same in every run with the same seed, so `--kinds photos --only N` repeats one. Work is done in
processes of their own, since a library that crashes takes its process along.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image, ImageCms, PngImagePlugin

from dior_rt.bundle import default_bundle, read_bundle
from dior_rt.errors import DiorError
from dior_rt.images.exr import write_exr
from dior_rt.images.photo import Photo, read_photo, write_photo
from dior_rt.images.strokes import read_drawing

SECONDS = 10
BATCH = 2000  # inputs of one worker, whose memory is then given back
SIZE = (14, 19)

Case = tuple[str, bytes]  # a file's suffix and content


def photos() -> list[Case]:
    """Small pictures of every format, with metadata and profiles."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    image, rgba = Image.fromarray(pixels), Image.fromarray(np.dstack([pixels, pixels[..., 0]]))
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x9286] = 6, "Camera", b"ASCII\0\0\0words"
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    made = []
    for form, suffix, options in (
        ("JPEG", ".jpg", {"exif": exif.tobytes(), "icc_profile": profile, "xmp": b"<x/>"}),
        ("PNG", ".png", {"exif": exif.tobytes(), "icc_profile": profile}),
        ("TIFF", ".tif", {"exif": exif.tobytes(), "icc_profile": profile, "compression": "tiff_deflate"}),
        ("TIFF", ".tif", {"compression": "tiff_lzw", "save_all": True, "append_images": [image]}),
        ("WEBP", ".webp", {"exif": exif.tobytes(), "lossless": True}),
        ("GIF", ".gif", {}),
        ("BMP", ".bmp", {}),
        ("JPEG2000", ".jp2", {}),
        ("AVIF", ".avif", {}),
        ("PPM", ".ppm", {}),
    ):
        file = io.BytesIO()
        (rgba if form == "WEBP" else image).save(file, form, **options)  # type: ignore[arg-type]
        made.append((suffix, file.getvalue()))
    made.append((".ppm", b"P6\n19 14\n65535\n" + rng.bytes(SIZE[0] * SIZE[1] * 6)))
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".png", ".tif"):
            path = Path(folder, f"deep{suffix}")
            deep = Photo(pixels.astype(np.uint16) * 257, icc=profile, iptc=b"\x1c\x02\x50\0\1A")
            write_photo(path, deep, {"seed": 1})
            made.append((suffix, path.read_bytes()))
    return made


def strokes() -> list[Case]:
    """Pictures and EXR files that are drawn light."""
    rng = np.random.default_rng(1)
    rgba = Image.fromarray(rng.integers(0, 256, (*SIZE, 4), dtype=np.uint8))
    info, file = PngImagePlugin.PngInfo(), io.BytesIO()
    info.add(b"oFFs", bytes(9))
    info.add(b"caNv", bytes(3) + b"\x13" + bytes(3) + b"\x0e" + bytes(8))
    info.add(b"cICP", bytes([12, 13, 0, 1]))
    info.add(b"gAMA", (45455).to_bytes(4, "big"))
    info.add(b"cHRM", bytes(range(32)))
    rgba.save(file, "PNG", pnginfo=info)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "s.exr")
        write_exr(path, rng.random((*SIZE, 4), np.float32))
        return [(".png", file.getvalue()), (".exr", path.read_bytes())]


def documents() -> list[Case]:
    """Strokes in JSON."""
    stroke = {"points": [[1, 2], [3.5, 4]], "width": 3, "color": "#ff8000", "intensity": 2, "softness": 0.5}
    text = json.dumps({"size": [19, 14], "strokes": [stroke, {**stroke, "color": [1, 2, 3]}]})
    return [(".json", text.encode()), (".json", text.encode("utf-16"))]


def arrays() -> list[Case]:
    """NPY files of both shapes."""
    made = []
    for channels in (3, 4):
        file = io.BytesIO()
        np.save(file, np.random.default_rng(2).random((*SIZE, channels), np.float32))
        made.append((".npy", file.getvalue()))
    return made


def manifests() -> list[Case]:
    """The manifest of the bundle that ships."""
    return [("manifest.json", (default_bundle() / "manifest.json").read_bytes())]


def graphs() -> list[Case]:
    """A small graph."""
    from onnx import TensorProto, helper

    floats = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 4]) for name in "xyz"]
    nodes = [helper.make_node("MatMul", ["x", "w"], ["y"]), helper.make_node("Relu", ["y"], ["z"])]
    weights = helper.make_tensor("w", TensorProto.FLOAT, [4, 4], [0.5] * 16)
    graph = helper.make_graph(nodes, "small", floats[:1], floats[2:], [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return [(".onnx", model.SerializeToString())]


def _read_picture(path: Path) -> None:
    photo = read_photo(path)
    out = path.with_name("out.png")
    write_photo(out, photo, {})
    out.unlink()


def _read_drawing(path: Path) -> None:
    read_drawing(path, SIZE)


def _read_manifest(path: Path) -> None:
    read_bundle(path.parent)


def _read_graph(path: Path) -> None:
    from dior_rt.engine import Engine

    Engine(path, "cpu", 1)


KINDS: dict[str, tuple[Callable[[], list[Case]], Callable[[Path], None], int]] = {
    # the sound files, what reads them, and their share of a hundred inputs
    "photos": (photos, _read_picture, 40),
    "strokes": (strokes, _read_drawing, 20),
    "json": (documents, _read_drawing, 15),
    "npy": (arrays, _read_drawing, 10),
    "manifests": (manifests, _read_manifest, 10),
    "graphs": (graphs, _read_graph, 5),
}


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """The file with one to eight changes; most of them near its beginning, where the headers are."""
    harmed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if not harmed:
            break
        near = min(len(harmed), 200) if rng.random() < 0.6 else len(harmed)
        at, length = int(rng.integers(near)), int(rng.integers(1, 9))
        match int(rng.integers(7)):
            case 0:
                harmed[at] = int(rng.integers(256))
            case 1:
                harmed[at] ^= 1 << int(rng.integers(8))
            case 2:
                harmed[at : at + length] = rng.choice([b"\0", b"\xff", b"\x7f", b"\x80"]) * length
            case 3:
                del harmed[at : at + length]
            case 4:
                harmed[at:at] = harmed[at : at + length * 4]
            case 5:
                harmed[at:at] = rng.bytes(length)
            case _ if rng.random() < 0.3:
                del harmed[at:]
    return bytes(harmed)


def work(kind: str, seed: int, first: int, count: int, folder: Path) -> None:
    """Read the inputs first .. first + count - 1 of a kind; one line to standard output before each, and a
    line that begins with FAULT for what must not be."""
    warnings.simplefilter("error", RuntimeWarning)
    make, read, _ = KINDS[kind]
    cases = make()
    for number in range(first, first + count):
        print(number, flush=True)
        rng = np.random.default_rng([seed, sorted(KINDS).index(kind), number])
        suffix, sound = cases[int(rng.integers(len(cases)))]
        path = folder / (suffix if suffix == "manifest.json" else f"in{suffix}")
        path.write_bytes(mutate(sound, rng))
        begun = time.process_time()
        try:
            read(path)
        except DiorError as error:
            if "\n" in str(error):
                print(f"FAULT more than one line: {error!r}", flush=True)
        except Exception as error:
            print(f"FAULT {type(error).__name__}: {str(error)[:200]!r}", flush=True)
        if (took := time.process_time() - begun) > SECONDS:
            print(f"FAULT took {took:.0f} s of the processor", flush=True)
        path.unlink()
        if left := [other.name for other in folder.iterdir()]:
            print(f"FAULT left {left}", flush=True)
            for name in left:
                (folder / name).unlink()


def _batches(kind: str, count: int, only: int | None) -> Iterator[tuple[int, int]]:
    if only is not None:
        yield only, 1
        return
    for first in range(0, count, BATCH):
        yield first, min(BATCH, count - first)


def run_batch(kind: str, seed: int, first: int, count: int) -> tuple[int, list[str]]:
    """Work in a process of its own. Returns how many inputs were read, and the faults.

    A process that crashes is started again behind the input that crashed it; one that is silent for too long
    is ended, by a limit that allows for a machine that is busy with other work.
    """
    faults: list[str] = []
    end = first + count
    while first < end:
        folder = Path(tempfile.mkdtemp(prefix="dior-fuzz-"))
        command = [sys.executable, "-m", "tools.fuzz", "--work", kind, "--seed", str(seed)]
        command += ["--first", str(first), "--count", str(end - first), "--folder", str(folder)]
        with tempfile.TemporaryFile("w+") as out:
            process = subprocess.Popen(command, stdout=out, stderr=subprocess.DEVNULL, env={**os.environ})
            size, quiet = -1, 0.0
            while process.poll() is None:
                time.sleep(0.25)
                now = os.fstat(out.fileno()).st_size
                quiet = 0.0 if now != size else quiet + 0.25
                size = now
                if quiet > 12 * SECONDS:
                    process.kill()
            out.seek(0)
            lines = out.read().splitlines()
        shutil.rmtree(folder, ignore_errors=True)
        at = first
        for line in lines:
            if line.startswith("FAULT"):
                faults.append(f"{kind} {at}: {line.removeprefix('FAULT ')}")
            elif line.isdecimal():
                at = int(line)
        if process.returncode == 0:
            break
        how = "hung" if quiet > 12 * SECONDS else f"ended the process ({process.returncode})"
        faults.append(f"{kind} {at}: {how}")
        first = at + 1
    return count, faults


def main(
    count: Annotated[int, typer.Option(min=1, help="How many inputs in all.")] = 100_000,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same inputs.")] = 0,
    kinds: Annotated[
        list[str] | None, typer.Option(help=f"Any of {', '.join(KINDS)}; may be repeated.")
    ] = None,
    only: Annotated[int | None, typer.Option(help="Repeat this one input of a kind.")] = None,
    work_kind: Annotated[str | None, typer.Option("--work", hidden=True)] = None,
    first: Annotated[int, typer.Option(hidden=True)] = 0,
    folder: Annotated[Path | None, typer.Option(hidden=True)] = None,
) -> None:
    """Read damaged files of every kind; exit code 1 where one is neither read nor refused in one sentence."""
    if work_kind and folder:
        return work(work_kind, seed, first, count, folder)
    chosen = kinds or list(KINDS)
    shares = sum(KINDS[kind][2] for kind in chosen)
    total, faults = 0, []
    for kind in chosen:
        read = 0
        for begin, size in _batches(kind, -(-count * KINDS[kind][2] // shares), only):
            done, found = run_batch(kind, seed, begin, size)
            read += done
            faults += found
            for fault in found:
                typer.echo(fault)
        total += read
        typer.echo(f"{kind}: {read} inputs, {sum(fault.startswith(kind) for fault in faults)} faults")
    typer.echo(f"{total} inputs, {len(faults)} faults")
    raise typer.Exit(bool(faults))


if __name__ == "__main__":
    typer.run(main)
