"""How long a person waits from lifting the pen to seeing the light.

    python -m tools.desk_latency [--strokes 50] [--megapixels 1 24]

Strokes are drawn with the mouse in a real browser on a photo of each size; the page itself measures from the
pen's lifting to the fine preview on the stage. Needs what tools.desk_pictures needs.
"""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image

from tools.command import start
from tools.desk_pictures import ROOT, open_desk, open_page


def main(
    strokes: Annotated[int, typer.Option(min=1, help="How many are drawn on each photo.")] = 50,
    megapixels: Annotated[tuple[float, float], typer.Option(help="Sizes of the two photos.")] = (1, 24),
) -> None:
    """Print median and 95th percentile, in milliseconds."""
    for size in megapixels:
        with tempfile.TemporaryDirectory() as folder:
            times = measure(enlarged(Path(folder), size), strokes)
        p95 = float(np.percentile(times, 95))
        print(f"{size:g} MP: median {statistics.median(times):.0f} ms, p95 {p95:.0f} ms")


def enlarged(folder: Path, megapixels: float) -> Path:
    """The example photo at another size."""
    with Image.open(ROOT / "examples/coffee.jpg") as photo:
        scale = (megapixels * 1e6 / (photo.width * photo.height)) ** 0.5
        large = photo.resize((round(photo.width * scale), round(photo.height * scale)))
    large.save(folder / "photo.jpg", quality=92)
    return folder / "photo.jpg"


def measure(photo: Path, strokes: int) -> list[float]:
    """Milliseconds from the pen's lifting to the first fine preview, for each of some strokes."""
    rng, times = np.random.default_rng(0), []
    with open_desk(photo) as link, open_page(link, "dark") as page:
        box = page.locator(".stage").bounding_box()
        assert box
        for _ in range(strokes + 1):
            x, y = rng.uniform(0.25, 0.65, 2)
            page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
            page.mouse.down()
            for _ in range(8):
                x, y = np.clip(np.add([x, y], rng.normal(0, 0.02, 2)), 0.2, 0.75)
                page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
            before = page.locator("html").get_attribute("data-fine") or "0"
            page.mouse.up()
            page.wait_for_selector(f"html[data-fine]:not([data-fine='{before}'])", timeout=60_000)
            times.append(float(page.locator("html").get_attribute("data-milliseconds") or "nan"))
            page.wait_for_selector(".stage:not(.busy)", timeout=60_000)
    return times[1:]  # the first one estimates the light on the photo


if __name__ == "__main__":
    start(main)
