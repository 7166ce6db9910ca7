"""Paths, shells and machines that wish no good: one sentence, the right exit code, nothing half-written."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.cli import run
from dior_rt.errors import InputError
from dior_rt.files import check_writable, replacing
from dior_rt.images.strokes import read_strokes

SIZE = (40, 60)
COMMAND = [sys.executable, "-m", "dior_rt"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with photo.png, strokes.png and s.json."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)).save("photo.png")
    strokes = np.zeros((*SIZE, 4), np.uint8)
    strokes[5:15, 10:30] = (255, 180, 100, 255)
    Image.fromarray(strokes).save("strokes.png")
    Path("s.json").write_text('[{"points": [[3, 4], [30, 20]], "width": 9}]')
    return tmp_path


@pytest.fixture
def says(folder: Path, mini_bundle: Path, capfd):
    """Assert one sentence, exit code 2 and no new file; return the sentence."""

    def check(*arguments: str) -> str:
        before = sorted(os.fsencode(path) for path in folder.rglob("*"))
        assert run([*arguments, "--bundle", str(mini_bundle), "--ops", "numpy"]) == 2
        said = capfd.readouterr()
        assert said.out == "" and said.err.startswith("dior-rt: ")
        assert said.err.endswith(".\n") and said.err.count("\n") == 1
        assert sorted(os.fsencode(path) for path in folder.rglob("*")) == before
        return said.err

    return check


# Paths


@pytest.mark.parametrize("photo", ["", ".", "/", "..", "a" * 300 + ".png", "光" * 90 + ".png"])
def test_a_photo_that_is_no_file(says, photo: str) -> None:
    assert "Cannot read the photo" in says("relight", photo, "s.json")
    assert "Cannot read the photo" in says("estimate", photo)
    assert "Cannot read the strokes" in says("relight", "photo.png", photo, "-o", "out.png")


@pytest.mark.parametrize("out", ["光" * 84 + ".png", "x" * 300 + ".png", "none/out.png", ".png/"])
def test_a_result_that_cannot_be_named(says, out: str) -> None:
    assert "Cannot write" in says("relight", "photo.png", "s.json", "-o", out)


def test_a_name_as_long_as_names_can_be(folder: Path) -> None:
    for name in ("光" * 83 + "_.png", "x" * 251 + ".png"):  # 254 and 255 bytes
        check_writable(folder / name)
        with replacing(folder / name) as file:
            file.write(b"whole")
        assert (folder / name).read_bytes() == b"whole"


def test_links(says, folder: Path) -> None:
    (folder / "loop.png").symlink_to("loop.png")
    assert "Cannot write loop.png" in says("relight", "photo.png", "s.json", "-o", "loop.png")
    assert "Cannot read" in says("relight", "loop.png", "s.json")
    (folder / "dangling.png").symlink_to(folder / "gone" / "there.png")
    text = says("relight", "photo.png", "s.json", "-o", "dangling.png")
    assert str(folder / "gone") in text and "the folder ." not in text
    (folder / "new.png").symlink_to("target.png")
    with replacing(folder / "new.png") as file:
        file.write(b"1")
    assert (folder / "target.png").read_bytes() == b"1" and (folder / "new.png").is_symlink()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may enter any folder")
def test_a_folder_without_x(says, folder: Path) -> None:
    (folder / "shut").mkdir()
    (folder / "shut" / "photo.png").write_bytes((folder / "photo.png").read_bytes())
    (folder / "shut").chmod(0o600)
    try:
        assert "ermission" in says("relight", "shut/photo.png", "s.json", "-o", "out.png")
        assert "ermission" in says("relight", "photo.png", "s.json", "-o", "shut/out.png")
    finally:
        (folder / "shut").chmod(0o700)


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="names are text there")
def test_names_in_bytes_that_are_no_text(folder: Path, mini_bundle: Path, capfd) -> None:
    import shutil

    for name in (b"caf\xe9.png", b"bundle\xff"):
        path = Path(os.fsdecode(name))
        if path.suffix:
            shutil.copy("photo.png", path)
            code = run(["relight", str(path), "s.json", "--bundle", str(mini_bundle), "--json"])
            assert (
                code == 0
                and os.fsencode(Path(json.loads(capfd.readouterr().out)["result"]).name)[:4] == b"caf\xe9"
            )
        else:
            shutil.copytree(mini_bundle, path)
            code = run(["relight", "photo.png", "s.json", "--bundle", str(path), "-o", "out.png"])
            assert code in (0, 2) and "Traceback" not in capfd.readouterr().err
    done = subprocess.run(
        [*COMMAND, "info", b"bundle\xff"], capture_output=True, timeout=120, cwd=folder, check=False
    )
    assert done.returncode == 0 and b"Traceback" not in done.stderr


# Files that are something else


def test_arrays_that_are_something_else(says, folder: Path) -> None:
    np.savez("map.npz", a=np.zeros((*SIZE, 3), np.float32))
    Path("map.npz").rename("map.npy")
    assert "archive of arrays" in says("relight", "photo.png", "map.npy")
    np.save("map.npy", np.zeros((*SIZE, 3), np.float32))
    whole = Path("map.npy").read_bytes()
    for damage in (b"(((((((", b"'''''''", b"\\\n\\\n\\\n\\", b"{[{[{[{"):
        Path("map.npy").write_bytes(whole[:20] + damage + whole[20 + len(damage) :])
        assert "Cannot read the strokes" in says("relight", "photo.png", "map.npy")


def test_a_damaged_avif(says, folder: Path) -> None:
    Image.open("photo.png").save("photo.avif")
    whole = Path("photo.avif").read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        harmed = np.frombuffer(whole, np.uint8).copy()
        harmed[rng.integers(0, len(whole), 8)] = rng.integers(0, 256, 8)
        Path("in.avif").write_bytes(harmed.tobytes())
        try:
            read_strokes(Path("in.avif"), SIZE)
        except InputError:
            refused += 1
    assert refused > 10


# Numbers


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--tolerance", "1e100000000"], "no number"),
        (["--tolerance", "1/0"], "no number"),
        (["--tolerance", "nan"], "no number"),
        (["--tolerance", "9" * 5000 + "/3"], "no number"),
        (["--guidance", "1e308"], "guidance"),
        (["--intensity", "1e38"], "too strong"),
        (["--intensity", "1e60"], "too strong"),
        (["--intensity", "1e308"], "too strong"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_numbers_at_the_ends(says, options: list[str], words: str) -> None:
    begun = time.monotonic()
    assert words in says("relight", "photo.png", "strokes.png", *options)
    assert time.monotonic() - begun < 60


@pytest.mark.parametrize("intensity", ["0", "1e-300", "1e8"])
@pytest.mark.filterwarnings("error")
def test_numbers_just_inside(folder: Path, mini_bundle: Path, capfd, intensity: str) -> None:
    options = ["--bundle", str(mini_bundle), "--ops", "numpy", "--intensity", intensity, "--guidance", "1000"]
    assert run(["relight", "photo.png", "strokes.png", *options]) == 0
    assert capfd.readouterr().err == ""


def test_a_stroke_of_a_light_that_float32_cannot_hold(says, folder: Path) -> None:
    Path("s.json").write_text('[{"points": [[3, 4]], "width": 9, "intensity": 1e60}]')
    assert "at most 1e+09" in says("relight", "photo.png", "s.json")


def test_a_hundred_thousand_points_take_linear_time() -> None:
    from dior_rt.kernels import NumpyOps, Stroke

    def seconds(count: int) -> float:
        turn = np.linspace(0, 60, count)
        spiral = zip(300 + 4 * turn * np.cos(turn), 200 + 3 * turn * np.sin(turn), strict=True)
        stroke = Stroke(tuple((float(x), float(y)) for x, y in spiral), 12.0)
        begun = time.process_time()
        NumpyOps().draw_strokes([stroke], (400, 600))
        return time.process_time() - begun

    seconds(1000)
    few, many = seconds(10_000), seconds(100_000)
    assert many < 12 * few + 0.2 and many < 3


# Unexpected errors


def test_the_last_resort_is_one_sentence_and_70(folder: Path, monkeypatch, capfd) -> None:
    def unforeseen(*_: object) -> None:
        raise TypeError("a\nb")

    monkeypatch.setattr("dior_rt.images.photo._read", unforeseen)
    monkeypatch.setattr("dior_rt.images.photo.DAMAGE", ())
    assert run(["estimate", "photo.png"]) == 70
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "TypeError: a b" in said and "--debug" in said
    assert run(["estimate", "photo.png", "--debug"]) == 70
    assert "Traceback" in capfd.readouterr().err


# Shells


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
def test_a_full_disk_behind_standard_output(mini_bundle: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, "info", str(mini_bundle), "--json"],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=120, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("dior-rt: Cannot print the result") and done.stderr.count("\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="needs a Unix shell")
@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams(folder: Path, mini_bundle: Path, closed: str) -> None:
    line = f'"$0" -m dior_rt relight photo.png s.json --bundle "{mini_bundle}" -o out.png {closed}'
    done = subprocess.run(["sh", "-c", line, sys.executable], cwd=folder, timeout=120, check=False)
    assert done.returncode == 0
    with Image.open(folder / "out.png") as image:
        image.load()
    line = f'"$0" -m dior_rt relight none.png s.json {closed}'
    assert (
        subprocess.run(["sh", "-c", line, sys.executable], cwd=folder, timeout=120, check=False).returncode
        == 2
    )


@pytest.mark.skipif(sys.platform == "win32", reason="this system has no modes")
def test_an_overwritten_file_keeps_its_mode(folder: Path) -> None:
    for mode in (0o600, 0o640, 0o664):
        (folder / "out.bin").touch()
        (folder / "out.bin").chmod(mode)
        with replacing(folder / "out.bin") as file:
            file.write(b"new")
        assert stat.S_IMODE((folder / "out.bin").stat().st_mode) == mode


@pytest.mark.skipif(sys.platform == "win32", reason="this system has other signals")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_while_writing_leaves_nothing(folder: Path, name: str) -> None:
    code = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "import dior_rt.cli as cli\n"
        "from dior_rt.files import replacing\n"
        "def work(arguments):\n"
        "    with replacing(Path('out.bin')) as file:\n"
        "        file.write(b'half'); file.flush(); print('writing', flush=True); time.sleep(60)\n"
        "cli.run = work\n"
        "cli.main()\n"
    )
    before = sorted(folder.iterdir())
    process = subprocess.Popen([sys.executable, "-c", code], cwd=folder, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "writing\n"
    assert len(list(folder.iterdir())) == len(before) + 1
    number = getattr(signal, name)
    process.send_signal(number)
    assert process.wait(60) == 128 + number
    process.stdout.close()
    assert sorted(folder.iterdir()) == before


# Machines


@pytest.mark.skipif(sys.platform != "linux", reason="strace and /proc are Linux's")
def test_a_relight_opens_no_socket_and_writes_nothing_but_its_result(folder: Path, mini_bundle: Path) -> None:
    home = folder / "home"
    home.mkdir()
    code = (
        "import socket, sys, os, threading, time\n"
        "def watch(event, arguments):\n"
        "    if event.startswith('socket.'): print('SOCKET', event, file=sys.stderr)\n"
        "sys.addaudithook(watch)\n"
        "seen, done = set(), threading.Event()\n"
        "def look():\n"
        "    while not done.is_set():\n"
        "        for number in os.listdir('/proc/self/fd'):\n"
        "            try: target = os.readlink(f'/proc/self/fd/{number}')\n"
        "            except OSError: continue\n"
        "            if target.startswith('socket:'): seen.add(target)\n"
        "        time.sleep(0.002)\n"
        "thread = threading.Thread(target=look); thread.start()\n"
        "from dior_rt.cli import run\n"
        "code = run(sys.argv[1:]); time.sleep(1); done.set(); thread.join()\n"
        "print('SOCKETS', sorted(seen), file=sys.stderr) if seen else None\n"
        "sys.exit(code)\n"
    )
    environment = {
        **os.environ,
        "HOME": str(home),
        "XDG_CACHE_HOME": str(home / ".cache"),
        "TMPDIR": str(home),
    }
    for name in ("ORT_DISABLE_TELEMETRY", "ORT_TELEMETRY_DISABLED", "POCL_CACHE_DIR", "CI"):
        environment.pop(name, None)
    arguments = ["relight", "photo.png", "s.json", "--bundle", str(mini_bundle), "-o", "out.png"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "SOCKET" not in done.stderr, done.stderr
    written = {path.relative_to(home).parts[:2] for path in home.rglob("*") if path.is_file()}
    assert {parts[0] for parts in written} <= {".cache"}, written
    assert not any("Microsoft" in str(parts) or "onnx" in str(parts).lower() for parts in written)


FORK = """
import multiprocessing, sys
import numpy as np
from dior_rt import Relighter
from dior_rt.errors import DiorError

relighter = Relighter(sys.argv[1], device="cpu")
photo = np.zeros((40, 60, 3), np.uint8)
strokes = np.full((40, 60, 4), 255, np.uint8)
relighter.relight(photo, strokes, steps=1)

def work(queue):
    try:
        relighter.relight(photo, strokes, steps=1)
        queue.put("done")
    except DiorError as error:
        queue.put(str(error))
    Relighter(sys.argv[1], device="cpu").relight(photo, strokes, steps=1)
    queue.put("done")

context = multiprocessing.get_context("fork")
queue = context.Queue()
child = context.Process(target=work, args=(queue,))
child.start()
print(queue.get(timeout=100))
print(queue.get(timeout=100))
child.join(20)
print(child.exitcode)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_fork_is_told_at_once_and_may_load_its_own(mini_bundle: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORK, str(mini_bundle)],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert len(lines) == 3, done.stderr
    assert "forked" in lines[0] and lines[1:] == ["done", "0"]
