"""The command line: results, reports, one sentence for what goes wrong, silence in a pipe."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt import __version__
from dior_rt.cli import run
from dior_rt.images.metadata import read_settings
from dior_rt.images.photo import Photo, read_photo, write_photo
from dior_rt.images.strokes import read_lumi, read_strokes

HEIGHT, WIDTH = 40, 60


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with photo.png and strokes.png."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[0 : 1 : HEIGHT * 1j, 0 : 1 : WIDTH * 1j]
    photo = np.stack([0.2 + 0.6 * x, 0.3 + 0.4 * y, 0.5 + 0.3 * np.sin(9 * x * y)], -1)
    Image.fromarray(np.round(photo * 255).astype(np.uint8)).save("photo.png")
    strokes = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    strokes[5:15, 10:30] = (255, 180, 100, 255)
    Image.fromarray(strokes).save("strokes.png")
    return tmp_path


@pytest.fixture
def relight(mini_bundle: Path, folder: Path):
    """Run `dior-rt relight photo.png strokes.png` with further arguments, on the small bundle."""

    def call(*arguments: str, photo: str = "photo.png", strokes: str = "strokes.png") -> int:
        common = ["--bundle", str(mini_bundle), "--ops", "numpy", "--overwrite"]
        return run(["relight", photo, strokes, *common, *arguments])

    return call


def pixels(name: str) -> np.ndarray:
    with Image.open(name) as image:
        return np.asarray(image)


def command(*arguments: str, **options: object) -> subprocess.CompletedProcess:
    """`dior-rt` as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "dior_rt", *arguments], capture_output=True, text=True, timeout=120, **options
    )


# Results


def test_relight_writes_a_picture_beside_the_photo_and_says_nothing(relight, capfd) -> None:
    assert relight() == 0
    assert pixels("photo-relit.png").shape == (HEIGHT, WIDTH, 3)
    assert (pixels("photo-relit.png") != pixels("photo.png")).any()
    said = capfd.readouterr()
    assert said.out == said.err == ""


def test_the_report_says_what_was_done(relight, capfd, mini_bundle: Path) -> None:
    assert relight("-o", "out.tif", "--seed", "5", "--steps", "3", "--guidance", "1.5", "--json") == 0
    report = json.loads(capfd.readouterr().out)
    assert report["result"] == "out.tif" and report["size"] == [WIDTH, HEIGHT] and report["notices"] == []
    settings = report["settings"]
    assert settings["version"] == __version__ and settings["bundle"] == "small"
    assert (settings["steps"], settings["guidance"], settings["seed"], settings["intensity"]) == (
        3,
        1.5,
        5,
        1.0,
    )
    assert len(settings["bundle_sha256"]) == 64
    assert report["ops"]["name"] == "numpy" and report["ops"]["reason"] and report["device"]["reason"]
    stages = report["seconds"]
    assert {"read", "load", "kernels", "steps", "transfer", "write", "first_step"} <= stages.keys()
    assert all(value >= 0 for value in stages.values())
    assert read_settings(Path("out.tif")) == settings


def test_the_model_supplies_steps_and_guidance(relight) -> None:
    assert relight("-o", "out.png") == 0
    settings = read_settings(Path("out.png"))
    assert settings["steps"] == 4 and settings["guidance"] == 2.0


def test_a_seed_is_a_result(relight) -> None:
    for name, seed in (("a.png", "1"), ("b.png", "1"), ("c.png", "2")):
        assert relight("-o", name, "--seed", seed) == 0
    np.testing.assert_array_equal(pixels("a.png"), pixels("b.png"))
    assert (pixels("a.png") != pixels("c.png")).any()


def test_the_same_light_in_every_format_is_the_same_result(relight) -> None:
    from dior_rt.images.exr import write_exr
    from dior_rt.kernels import NumpyOps

    raster = read_strokes(Path("strokes.png"), (HEIGHT, WIDTH))
    light = NumpyOps().decode_srgb(raster[..., :3])
    mask = (raster[..., 3:] / 255).astype(np.float32)
    np.save("strokes.npy", np.concatenate([light, mask], -1))
    write_exr(Path("dense.exr"), light)  # outside the strokes it is exactly black
    Image.fromarray(raster[..., :3]).save("dense.png")
    assert relight("-o", "png.png") == 0
    for strokes, *key in (["strokes.npy"], ["dense.exr", "--key", "black"], ["dense.png", "--key", "black"]):
        assert relight("-o", "other.png", *key, strokes=strokes) == 0
        np.testing.assert_array_equal(pixels("other.png"), pixels("png.png"))
    assert relight("-o", "dense-result.png", strokes="dense.png") == 0
    assert (pixels("dense-result.png") != pixels("png.png")).any()


def test_intensity_multiplies_the_light(relight) -> None:
    stroke = {"points": [[10, 10], [40, 20]], "width": 9, "color": [0.5, 0.25, 0.125]}
    Path("one.json").write_text(json.dumps([stroke]))
    Path("four.json").write_text(json.dumps([{**stroke, "intensity": 4}]))
    assert relight("-o", "a.png", "--intensity", "4", strokes="one.json") == 0
    assert relight("-o", "b.png", strokes="four.json") == 0
    assert relight("-o", "c.png", strokes="one.json") == 0
    np.testing.assert_array_equal(pixels("a.png"), pixels("b.png"))
    assert (pixels("a.png") != pixels("c.png")).any()


def test_within_a_short_reach_the_photo_stays_far_from_the_strokes(relight) -> None:
    Path("one.json").write_text(json.dumps([{"points": [[5, 5], [10, 5]], "width": 8, "intensity": 4}]))
    assert relight("-o", "far.png", strokes="one.json") == 0
    assert relight("-o", "near.png", "--reach", "0.05", strokes="one.json") == 0
    corner = slice(HEIGHT // 2, None), slice(WIDTH // 2, None)
    assert (pixels("far.png")[corner] != pixels("photo.png")[corner]).any()
    np.testing.assert_array_equal(pixels("near.png")[corner], pixels("photo.png")[corner])
    assert (pixels("near.png")[:10, :15] != pixels("photo.png")[:10, :15]).any()
    assert [read_settings(Path(f"{name}.png"))["reach"] for name in ("near", "far")] == [0.05, None]


def test_strokes_of_another_size_but_the_same_shape(relight) -> None:
    with Image.open("strokes.png") as image:
        image.resize((WIDTH * 4, HEIGHT * 4), Image.Resampling.NEAREST).save("large.png")
    assert relight("-o", "a.png") == 0
    assert relight("-o", "b.png", strokes="large.png") == 0
    np.testing.assert_array_equal(pixels("a.png"), pixels("b.png"))


def test_strokes_that_say_nothing_leave_the_photo_alone(relight, capfd) -> None:
    Image.new("RGBA", (WIDTH, HEIGHT)).save("strokes.png")
    assert relight() == 0
    np.testing.assert_array_equal(pixels("photo-relit.png"), pixels("photo.png"))
    assert "nothing" in capfd.readouterr().err
    assert relight("--json") == 0
    assert "nothing" in json.loads(capfd.readouterr().out)["notices"][0]


def test_depth_orientation_and_alpha_survive_the_command(relight) -> None:
    rng = np.random.default_rng(0)
    deep = rng.integers(0, 65536, (HEIGHT, WIDTH, 3), dtype=np.uint16)
    write_photo(Path("deep.png"), Photo(deep, rng.integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)), {})
    assert relight(photo="deep.png") == 0
    photo, relit = read_photo(Path("deep.png")), read_photo(Path("deep-relit.png"))
    assert relit.bits == 16 and (relit.pixels % 257 != 0).any()
    np.testing.assert_array_equal(relit.alpha, photo.alpha)

    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open("photo.png") as image:
        image.rotate(90, expand=True).save("turned.jpg", exif=exif.tobytes(), quality=95)
    assert relight(photo="turned.jpg") == 0
    assert pixels("turned-relit.png").shape == (HEIGHT, WIDTH, 3)


def test_estimate_sparsify_relight(mini_bundle: Path, folder: Path, capfd) -> None:
    common = ["--bundle", str(mini_bundle), "--ops", "numpy", "--seed", "3"]
    assert run(["estimate", "photo.png", *common]) == 0
    lumi = read_lumi(Path("photo-lumi.exr"))
    assert lumi.min() >= 0 and lumi.shape[1] > lumi.shape[0]
    assert run(["estimate", "photo.png", "-o", "lumi.png", *common, "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["size"] == [lumi.shape[1], lumi.shape[0]]
    np.testing.assert_allclose(read_lumi(Path("lumi.png")), np.minimum(lumi, 1), atol=0.005)

    for mode, share in (("strokes", (0, 1)), ("dense", (1, 1))):
        assert run(["sparsify", "photo-lumi.exr", "-o", f"{mode}.npy", "--mode", mode, "--seed", "2"]) == 0
        raster = read_strokes(Path(f"{mode}.npy"), (HEIGHT, WIDTH))
        kept = raster[..., 3] > 0
        assert share[0] <= kept.mean() <= share[1] and kept.any()
        np.testing.assert_array_equal(raster[kept, :3], lumi[kept])
    assert run(["relight", "photo.png", "strokes.npy", *common]) == 0


def test_sparsify_says_when_a_png_clips(folder: Path, capfd) -> None:
    np.save("bright.npy", np.full((8, 8, 3), 3, np.float32))
    assert run(["sparsify", "bright.npy", "-o", "s.png", "--mode", "dense"]) == 0
    assert "clipped" in capfd.readouterr().err
    assert run(["sparsify", "bright.npy", "-o", "s.npy", "--mode", "dense"]) == 0
    assert capfd.readouterr().err == ""


def test_info(mini_bundle: Path, capfd) -> None:
    assert run(["info", str(mini_bundle)]) == 0
    assert "small" in capfd.readouterr().out
    assert run(["info", str(mini_bundle), "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert report["family"] == "mini" and report["steps"] == 4


def test_devices_names_what_the_options_take(mini_bundle: Path, folder: Path, capfd) -> None:
    assert run(["devices", "--bundle", str(mini_bundle), "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    usable = {
        kind: [device["name"] for device in survey["devices"] if device["problem"] is None]
        for kind, survey in report.items()
    }
    assert "cpu" in usable["network"] and "numpy" in usable["ops"]
    assert report["network"]["auto"]["name"].split(" ")[0] in usable["network"]
    assert report["network"]["auto"]["reason"] and report["ops"]["auto"]["reason"]
    common = ["--bundle", str(mini_bundle), "--steps", "1"]
    for ops in usable["ops"]:
        assert (
            run(
                ["relight", "photo.png", "strokes.png", *common, "--ops", ops, "-o", "out.png", "--overwrite"]
            )
            == 0
        )
    capfd.readouterr()

    assert run(["devices", "--bundle", str(mini_bundle)]) == 0
    said = capfd.readouterr().out
    assert said.count("  auto ") == 2 and all(name in said for names in usable.values() for name in names)


# Errors


@pytest.fixture
def refuses(folder: Path, capfd):
    """Assert that a command line ends with one sentence and exit code 2, and writes nothing."""

    def check(*arguments: str, words: str) -> None:
        before = sorted(folder.rglob("*"))
        assert run(arguments) == 2
        said = capfd.readouterr()
        assert said.out == ""
        assert said.err.startswith("dior-rt: ") and said.err.endswith(".\n") and said.err.count("\n") == 1
        assert words in said.err
        assert sorted(folder.rglob("*")) == before

    return check


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--steps", "0"], "--steps"),
        (["--steps", "1001"], "--steps"),
        (["--steps", "many"], "--steps"),
        (["--guidance", "nan"], "--guidance"),
        (["--guidance", "inf"], "--guidance"),
        (["--guidance", "-1"], "--guidance"),
        (["--intensity", "-1"], "--intensity"),
        (["--intensity", "nan"], "--intensity"),
        (["--seed", "-1"], "--seed"),
        (["--reach", "0"], "reach"),
        (["--reach", "inf"], "--reach"),
        (["--key", "white"], "--key"),
        (["--colour", "red"], "--colour"),
        (["third"], "third"),
        (["-o", "photo.png"], "read from"),
        (["-o", "./strokes.png"], "read from"),
        (["-o", "out.xyz"], "must end in"),
        (["-o", "none/out.png"], "does not exist"),
        (["--bundle", "none"], "none"),
        (["--device", "abacus"], "abacus"),
        (["--ops", "abacus"], "abacus"),
        (["--intensity", "1e39"], "too strong"),
    ],
)
def test_bad_options(refuses, mini_bundle: Path, options: list[str], words: str) -> None:
    bundle = [] if "--bundle" in options else ["--bundle", str(mini_bundle)]
    refuses("relight", "photo.png", "strokes.png", *bundle, *options, words=words)


def test_bad_files(refuses, folder: Path, mini_bundle: Path) -> None:
    Path("words.png").write_text("no picture")
    Path("cut.png").write_bytes(Path("photo.png").read_bytes()[:900])
    Image.new("RGBA", (WIDTH, WIDTH), "white").save("square.png")
    np.save("negative.npy", np.full((HEIGHT, WIDTH, 3), -1, np.float32))
    np.save("nan.npy", np.full((HEIGHT, WIDTH, 3), np.nan, np.float32))
    Path("bad.json").write_text('[{"points": [[1, 2]], "width": 3, "colour": "#ffffff"}]')
    cases = [
        ("missing.png", "strokes.png", "no such file"),
        ("photo.png", "missing.png", "no such file"),
        ("words.png", "strokes.png", "not a picture"),
        ("cut.png", "strokes.png", "cut.png"),
        (str(folder), "strokes.png", "folder"),
        ("photo.png", "square.png", "60 x 60"),
        ("photo.png", "negative.npy", "not negative"),
        ("photo.png", "nan.npy", "finite"),
        ("photo.png", "bad.json", "'colour'"),
    ]
    for photo, strokes, words in cases:
        refuses("relight", photo, strokes, "--bundle", str(mini_bundle), "-o", "out.png", words=words)


def test_other_commands_refuse_as_well(refuses, mini_bundle: Path) -> None:
    refuses("frobnicate", words="frobnicate")
    refuses("relight", words="PHOTO")
    refuses("estimate", "photo.png", "-o", "lumi.txt", "--bundle", str(mini_bundle), words="must end in")
    refuses("estimate", "photo.png", "-o", "photo.png", "--bundle", str(mini_bundle), words="read from")
    refuses("sparsify", "photo.png", words="--out")
    refuses("sparsify", "strokes.png", "-o", "s.png", words="unspecified")
    refuses("sparsify", "photo.png", "-o", "s.jpg", words=".npy")
    refuses("info", "none", words="none")
    refuses("export", "none", "-o", "out", words="none")


def test_a_tampered_bundle_is_refused(refuses, folder: Path, mini_bundle: Path) -> None:
    import shutil

    shutil.copytree(mini_bundle, folder / "bundle")
    graph = folder / "bundle" / "velocity.onnx"
    data = bytearray(graph.read_bytes())
    data[len(data) // 2] ^= 1
    graph.write_bytes(data)
    refuses("relight", "photo.png", "strokes.png", "--bundle", "bundle", words="velocity.onnx")
    refuses("info", "bundle", words="velocity.onnx")


def test_debug_shows_where_it_happened(folder: Path, capfd) -> None:
    assert run(["relight", "missing.png", "strokes.png", "--debug"]) == 2
    said = capfd.readouterr().err
    assert "Traceback" in said and "FileNotFoundError" in said
    assert said.splitlines()[-1].startswith("dior-rt: ")


@pytest.fixture
def listening() -> Iterator[None]:
    """Ctrl-C as in a terminal: a shell starts its background jobs deaf to it, and children inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("listening")
def test_ctrl_c_is_130_and_leaves_nothing(relight, folder: Path, monkeypatch, capfd) -> None:
    from contextlib import contextmanager

    @contextmanager
    def interrupting(label: str, quiet: bool):
        yield lambda step, steps: signal.raise_signal(signal.SIGINT) if step == 2 else None

    monkeypatch.setattr("dior_rt.cli.pictures._progress", interrupting)
    before = sorted(folder.iterdir())
    assert relight() == 130
    assert sorted(folder.iterdir()) == before
    assert "Traceback" not in capfd.readouterr().err


# As a process


def test_help_teaches_and_loads_nothing_heavy() -> None:
    check = (
        "import sys; from dior_rt.cli import run; run(['--help']); run(['relight', '--help'])\n"
        "heavy = ('numpy', 'PIL', 'onnxruntime', 'pyopencl', 'OpenEXR', 'torch')\n"
        "print('LOADED', [name for name in heavy if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert result.stdout.rstrip().endswith("LOADED []")
    for word in ("relight", "estimate", "sparsify", "devices", "info", "export", "train"):
        assert f"  {word} " in result.stdout
    assert "dior-rt relight photo.jpg strokes.png" in result.stdout


@pytest.mark.parametrize("name", ["relight", "estimate", "sparsify", "devices", "info", "export"])
def test_every_command_has_help(name: str, capfd) -> None:
    assert run([name, "--help"]) == 0
    said = capfd.readouterr().out
    assert f"Usage: dior-rt {name}" in said and f"\n    dior-rt {name}" in said


def test_the_process_speaks_and_exits_like_the_function(folder: Path) -> None:
    result = command("--version")
    assert (result.returncode, result.stdout, result.stderr) == (0, f"{__version__}\n", "")
    result = command("relight", "photo.png", "missing.png")
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.startswith("dior-rt: ") and result.stderr.count("\n") == 1


def test_a_closed_pipe_is_quiet(mini_bundle: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "dior_rt", "info", str(mini_bundle), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout and process.stderr
    process.stdout.close()
    with process.stderr:
        assert process.stderr.read() == ""
    process.wait(60)


@pytest.mark.skipif(sys.platform == "win32", reason="this system has no pseudo-terminals")
def test_a_terminal_shows_progress(folder: Path, mini_bundle: Path) -> None:
    import pty

    ours, theirs = pty.openpty()
    arguments = ["relight", "photo.png", "strokes.png", "--bundle", str(mini_bundle), "--ops", "numpy"]
    process = subprocess.Popen([sys.executable, "-m", "dior_rt", *arguments], stderr=theirs, stdout=theirs)
    os.close(theirs)
    shown = b""
    while True:
        try:
            data = os.read(ours, 4096)
        except OSError:  # Linux's way to say that the other end is closed
            break
        if not data:
            break
        shown += data
    os.close(ours)
    assert process.wait(60) == 0
    assert b"Relighting" in shown and b"100%" in shown
