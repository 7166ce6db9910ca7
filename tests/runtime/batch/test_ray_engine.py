"""The engine on Ray, with two workers: its bytes equal the local engine's, and a dead worker loses no
photo.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.batch.journal import NAME, read_journal

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found by /proc"),
]
PHOTOS = 16


@pytest.fixture
def command(tmp_path: Path, mini_bundle: Path, monkeypatch) -> list[str]:
    """Return the command `dior-rt batch in` on the small bundle, in a folder with photos."""
    pytest.importorskip("ray.data")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    for i in range(PHOTOS):
        colour = np.random.default_rng(i).uniform(40, 200, 3)
        Image.fromarray(np.full((400, 600, 3), colour, np.uint8)).save(f"in/{i}.png")
    strokes = np.zeros((40, 60, 4), np.uint8)
    strokes[5:15, 10:30] = (255, 180, 100, 255)
    Image.fromarray(strokes).save("one.png")
    model = ["--bundle", str(mini_bundle), "--ops", "numpy", "--strokes", "one.png", "--at-once", "2"]
    return [sys.executable, "-m", "dior_rt", "batch", "in", *model, "-o"]


def results(folder: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in Path(folder).glob("*.png")}


def wait_for(count: int, process: subprocess.Popen) -> None:
    """Wait until that number of results exists."""
    while len(results("out")) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


def workers(driver: int) -> list[int]:
    """Return the processes of a driver's actors."""
    parents, found = {}, []
    for entry in Path("/proc").iterdir():
        try:
            parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if (entry / "cmdline").read_bytes().startswith(b"ray::MapWorker"):
                found.append(int(entry.name))
        except (ValueError, OSError):
            continue

    def descends(process: int) -> bool:
        while process > 1:
            process = parents.get(process, 0)
            if process == driver:
                return True
        return False

    return [process for process in found if descends(process)]


def test_a_killed_worker_loses_no_photo(command: list[str]) -> None:
    subprocess.run([*command, "here"], check=True, capture_output=True)
    process = subprocess.Popen([*command, "out", "--engine", "ray"], stderr=subprocess.PIPE, text=True)
    wait_for(2, process)
    victims = workers(process.pid)
    assert victims
    os.kill(victims[0], signal.SIGKILL)
    said = process.communicate(timeout=300)[1]
    assert process.returncode == 0, said
    assert results("out") == results("here") and len(results("here")) == PHOTOS
    lines = [json.loads(line) for line in (Path("out") / NAME).read_text().splitlines()]
    assert set(Counter(line["result"] for line in lines if line["state"] == "done").values()) == {1}


def test_a_killed_driver_is_started_anew(command: list[str]) -> None:
    subprocess.run([*command, "here"], check=True, capture_output=True)
    process = subprocess.Popen([*command, "out", "--engine", "ray"], stderr=subprocess.DEVNULL)
    wait_for(4, process)
    process.kill()
    process.wait()
    time.sleep(2)  # its workers end with it
    done = {name for name, record in read_journal(Path("out")).items() if record.is_done}
    times = {name: Path("out", name).stat().st_mtime_ns for name in done}
    again = subprocess.run(
        [*command, "out", "--engine", "ray", "--json"], capture_output=True, text=True, timeout=300
    )
    assert again.returncode == 0, again.stderr
    report = json.loads(again.stdout)
    assert report["done_before"] == len(done) and report["relit"] == PHOTOS - len(done)
    assert times == {name: Path("out", name).stat().st_mtime_ns for name in times}
    assert results("out") == results("here")


def test_a_cluster_that_is_not_there_is_one_sentence(command: list[str]) -> None:
    result = subprocess.run(
        [*command, "out", "--engine", "ray", "--address", "127.0.0.1:1"], capture_output=True, text=True
    )
    assert result.returncode == 2 and "127.0.0.1:1" in result.stderr
    assert result.stderr.count("\n") == 1, result.stderr
