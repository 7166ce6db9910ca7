"""The pictures of docs/desk.md: screenshots of the light desk in its main states.

    python -m tools.desk_pictures [FOLDER]

Needs dior-rt[desk], playwright, and Chromium on the path.
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from tools.command import start

ROOT = Path(__file__).parents[1]
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-sync",
]
STROKE = [(0.3, 0.2), (0.28, 0.35), (0.33, 0.55), (0.38, 0.62)]


def main(
    folder: Annotated[Path, typer.Argument(help="Where the pictures go.")] = ROOT / "docs/pictures",
) -> None:
    """Write desk-draw.jpg, desk-map.jpg, desk-compare.jpg, desk-light.jpg and desk-phone.jpg."""
    with open_desk(ROOT / "examples/coffee.jpg") as link, open_page(link, "dark") as page:
        draw(page, STROKE)
        save(page, folder / "desk-draw.jpg")
        page.locator("select.add").select_option("background")
        settle(page)
        page.keyboard.press("t")
        page.wait_for_timeout(800)
        save(page, folder / "desk-map.jpg")
        page.keyboard.press("t")
        page.keyboard.press("c")
        page.wait_for_timeout(300)
        save(page, folder / "desk-compare.jpg")
        page.keyboard.press("c")
        page.emulate_media(color_scheme="light")
        page.keyboard.press("d")
        page.wait_for_timeout(500)
        save(page, folder / "desk-light.jpg")
        page.keyboard.press("d")
        page.emulate_media(color_scheme="dark")
        page.keyboard.press("0")
        page.set_viewport_size({"width": 390, "height": 844})
        page.wait_for_timeout(800)
        save(page, folder / "desk-phone.jpg")


@contextmanager
def open_desk(photo: Path) -> Iterator[str]:
    """Run the desk's command with a photo; the link that it prints."""
    command = [sys.executable, "-m", "dior_rt", "desk", str(photo), "--no-browser", "--port", "0"]
    desk = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert desk.stdout
        found = re.search(r"http\S+", desk.stdout.readline())
        assert found, "the desk printed no link"
        yield found[0]
    finally:
        desk.terminate()
        desk.wait()


@contextmanager
def open_page(link: str, scheme: Any) -> Iterator[Page]:
    """The desk's page in a browser, ready to draw on."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 860}, color_scheme=scheme)
        page.goto(link)
        page.wait_for_selector("html[data-ready=true]", timeout=120_000)
        yield page
        browser.close()


def draw(page: Page, way: list[tuple[float, float]]) -> None:
    """Pull the mouse along points of the stage, in shares of its sides, and wait for the finest preview."""
    box = page.locator(".stage").bounding_box()
    assert box
    places = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in way]
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place, steps=8)
    page.mouse.up()
    settle(page)


def settle(page: Page) -> None:
    """Wait until no preview is under way."""
    page.wait_for_timeout(1500)
    page.wait_for_selector(".stage:not(.busy)", timeout=120_000)


def save(page: Page, path: Path) -> None:
    """Write what the page shows as a JPEG."""
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(path, quality=85)
    print(path)


if __name__ == "__main__":
    start(main)
