"""`dior-rt batch`: results, repeated work, files that are kept, and a kill in the middle."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.batch.journal import NAME, read_journal
from dior_rt.cli import run
from tests.runtime.cli.conftest import make_photo, make_strokes

Batch = Callable[..., tuple[int, dict]]


@pytest.fixture
def batch(folder: Path, model: list[str], capfd) -> Batch:
    """Run `dior-rt batch` with --json; return its exit code and report."""

    def call(*arguments: str, inputs: tuple[str, ...] = ("in",), out: str = "out") -> tuple[int, dict]:
        capfd.readouterr()
        code = run(["batch", *inputs, "-o", out, "--json", *model, *arguments])
        text = capfd.readouterr().out
        return code, json.loads(text) if text else {}

    fill(Path("in"), 3)
    return call


def fill(folder: Path, count: int) -> None:
    """Write photos 0.png, 1.png ... of different colours, each with its strokes."""
    folder.mkdir()
    for i in range(count):
        make_photo(i).save(folder / f"{i}.png")
        make_strokes().save(folder / f"{i}-light.png")


def pixels(path: str | Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_every_result_is_that_of_relight(batch: Batch, model: list[str]) -> None:
    code, report = batch()
    assert code == 0 and (report["relit"], report["failed"]) == (3, [])
    assert sorted(path.name for path in Path("out").iterdir()) == [NAME, "0.png", "1.png", "2.png"]
    for i in range(3):
        assert run(["relight", f"in/{i}.png", f"in/{i}-light.png", "-o", f"{i}.png", *model]) == 0
        np.testing.assert_array_equal(pixels(f"out/{i}.png"), pixels(f"{i}.png"))


def test_done_work_is_not_done_again_and_changed_work_is(batch: Batch) -> None:
    batch()
    times = {path: path.stat().st_mtime_ns for path in Path("out").glob("*.png")}
    assert batch()[1]["done_before"] == 3
    assert times == {path: path.stat().st_mtime_ns for path in Path("out").glob("*.png")}
    make_photo(9).save("in/1.png")
    code, report = batch()
    assert code == 0 and (report["relit"], report["done_before"]) == (1, 2)
    assert (pixels("out/1.png") != pixels("out/0.png")).any()
    assert batch("--seed", "5")[1]["relit"] == 3


def test_failures_are_listed_and_do_not_stop_the_rest(batch: Batch) -> None:
    Path("in/1.png").write_bytes(Path("in/1.png").read_bytes()[:500])
    Path("in/2-light.png").unlink()
    code, report = batch()
    assert code == 1 and report["relit"] == 1
    reasons = {failure["photo"]: failure["reason"] for failure in report["failed"]}
    assert "in/1.png" in reasons["in/1.png"] and "no strokes" in reasons["in/2.png"]
    shutil.copy("in/0.png", "in/1.png")
    shutil.copy("in/0-light.png", "in/2-light.png")
    assert batch()[1]["relit"] == 2


def test_results_of_others_are_kept(batch: Batch) -> None:
    Path("out").mkdir()
    Path("out/0.png").write_text("mine")
    code, report = batch()
    assert code == 1 and "--overwrite" in report["failed"][0]["reason"]
    assert Path("out/0.png").read_text() == "mine"
    assert batch("--overwrite")[0] == 0 and pixels("out/0.png").shape == (40, 60, 3)


def test_a_dry_run_writes_nothing(batch: Batch, model: list[str], capfd) -> None:
    code, rows = batch("--dry-run")
    assert code == 0 and len(rows) == 3 and not Path("out").exists()
    assert run(["batch", "in", "-o", "out", "--dry-run", *model]) == 0
    said = capfd.readouterr().out.splitlines()
    assert said[0] == f"{Path('in/0.png')} + {Path('in/0-light.png')} -> {Path('out/0.png')}"
    assert said[-1].startswith("3 to relight") and not Path("out").exists()


def test_one_drawing_for_all_fits_every_size_of_its_shape(batch: Batch) -> None:
    make_photo(5, (80, 120)).save("in/large.png")
    code, report = batch("--strokes", "strokes.png", "--format", "jpg")
    assert code == 0 and report["relit"] == 4
    assert pixels("out/large.jpg").shape == (80, 120, 3)


def test_a_list_on_standard_input(batch: Batch, stdin) -> None:
    stdin(b"in/0.png\0in/2.png\0")
    assert batch(inputs=("-",))[1]["relit"] == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none", "-o", "out"], "none is not there"),
        (["in", "-o", "photo.png"], "photo.png"),
        (["in", "-o", "out", "--strokes", "none.json"], "no such file"),
        (["empty", "-o", "out"], "no photos"),
        (["in"], "--out"),
        (["in", "-o", "out", "--at-once", "0"], "--at-once"),
    ],
)
def test_what_cannot_be_is_one_sentence(batch: Batch, model, capfd, arguments: list[str], words: str) -> None:
    Path("empty").mkdir()
    assert run(["batch", *arguments, *model]) == 2
    said = capfd.readouterr().err
    assert words in said and said.count("\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_killed_in_the_middle_it_goes_on_and_ends_as_if_it_had_not_been(
    folder: Path, model: list[str]
) -> None:
    fill(Path("in"), 12)
    command = [sys.executable, "-m", "dior_rt", "batch", "in", *model, "--steps", "2", "-o"]
    subprocess.run([*command, "whole"], check=True, capture_output=True)
    for _ in range(2):
        process = subprocess.Popen([*command, "out"], stderr=subprocess.DEVNULL)
        before = len(list(Path("out").glob("*.png"))) if Path("out").is_dir() else 0
        while process.poll() is None and len(list(Path("out").glob("*.png"))) < before + 3:
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
        assert process.wait(60) == -signal.SIGKILL
    done = {name for name, record in read_journal(Path("out")).items() if record.is_done}
    assert 0 < len(done) < 12
    (Path("out") / ".0123456789abcdef.part").write_bytes(
        b"cut"
    )  # as a process leaves that dies while it writes
    with (Path("out") / NAME).open("a") as journal:
        journal.write('{"state": "begun", "result": "11.png"}\n{"state": "do')
    times = {name: (Path("out") / name).stat().st_mtime_ns for name in done - {"11.png"}}
    subprocess.run([*command, "out"], check=True, capture_output=True)
    assert times == {name: (Path("out") / name).stat().st_mtime_ns for name in times}
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(
        p.name for p in Path("whole").iterdir()
    )
    for i in range(12):
        assert Path(f"out/{i}.png").read_bytes() == Path(f"whole/{i}.png").read_bytes()


def test_a_project_of_the_light_desk_is_relit_by_its_settings(batch: Batch, model: list[str]) -> None:
    from dior_rt.project import LightRecord, PhotoRef, Project, Settings, ShapeRecord, write_project

    stroke = ShapeRecord("stroke", ((10.0, 10.0), (40.0, 20.0)), intensity=3.0, width=12.0)
    project = Project(PhotoRef((60, 40)), (LightRecord(shapes=(stroke,)),), Settings(steps=2, seed=5))
    Path("in/0-light.png").unlink()
    write_project(Path("in/0.dior"), project)
    code, report = batch()
    assert code == 0 and report["relit"] == 3
    assert run(["relight", "in/0.png", "in/0.dior", "-o", "0.png", *model]) == 0
    np.testing.assert_array_equal(pixels("out/0.png"), pixels("0.png"))
    assert (pixels("out/0.png") != pixels("in/0.png")).any()
