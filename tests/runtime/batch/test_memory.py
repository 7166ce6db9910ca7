"""A batch keeps to its limit of pixels in memory, however many photos there are."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

CODE = """
import resource, sys
from dior_rt.cli import run
code = run(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
sys.exit(code)
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(resource, "RUSAGE_SELF") or sys.platform == "darwin", reason="ru_maxrss is in kB"
)
def test_memory_does_not_grow_with_the_number_of_photos(tmp_path: Path, mini_bundle: Path) -> None:
    Image.fromarray(np.full((40, 60, 4), 255, np.uint8)).save(tmp_path / "one.png")
    noise = np.random.default_rng(0).integers(0, 256, (2000, 3000, 3), np.uint8)
    peaks = {}
    for count in (4, 24):
        folder = tmp_path / str(count)
        folder.mkdir()
        for i in range(count):
            Image.fromarray(noise).save(folder / f"{i}.jpg")
        model = ["--bundle", str(mini_bundle), "--ops", "numpy", "--steps", "1", "--quiet", "--format", "jpg"]
        batch = ["batch", str(folder), "-o", str(folder / "out"), "--strokes", str(tmp_path / "one.png")]
        result = subprocess.run(
            [sys.executable, "-c", CODE, *batch, *model, "--in-flight", "13"],
            capture_output=True,
            text=True,
            check=True,
        )
        peaks[count] = int(result.stdout) / 1024
    assert peaks[24] <= 1.15 * peaks[4] + 50, peaks
