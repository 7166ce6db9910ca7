"""An open desk, and a real browser. Tests that need the browser skip with a reason where there is none."""

from __future__ import annotations

import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.relight import Relighter

uvicorn = pytest.importorskip("uvicorn", reason="the extra `desk` is not installed")

from dior_rt.desk.app import make_app  # noqa: E402
from dior_rt.desk.studio import Studio  # noqa: E402

TOKEN = "the-token-of-the-tests"
CHROMIUM = next((path for name in ("chromium", "google-chrome") if (path := shutil.which(name))), None)
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@dataclass(frozen=True)
class Desk:
    """A desk that is served. link: the link to its page; folder: the folder of its temporary files."""

    link: str
    host: str
    folder: Path
    photo: Path


@pytest.fixture(scope="session")
def relighter(mini_bundle) -> Relighter:
    return Relighter(mini_bundle, device="cpu", ops="numpy")


@pytest.fixture(scope="session")
def photo_file(tmp_path_factory) -> Path:
    """Write a photo of 480 x 320 with large soft areas, dark enough to be lit."""
    rng = np.random.default_rng(11)
    coarse = Image.fromarray(rng.integers(40, 130, (4, 6, 3), dtype=np.uint8))
    path = tmp_path_factory.mktemp("photos") / "scene.png"
    coarse.resize((480, 320), Image.Resampling.BICUBIC).save(path)
    return path


@pytest.fixture(scope="session")
def serve(relighter, tmp_path_factory) -> Iterator[Callable[[Path | None], Desk]]:
    """Serve a desk that begins with a photo, or with none."""
    servers = []

    def start(photo: Path | None) -> Desk:
        listener = socket.socket()
        listener.bind(("127.0.0.1", 0))
        host = f"127.0.0.1:{listener.getsockname()[1]}"
        folder = tmp_path_factory.mktemp("desk")
        app = make_app(Studio(lambda: relighter, folder), TOKEN, frozenset({host}), photo)
        config = uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        servers.append((server, thread))
        until = time.monotonic() + 20
        while not server.started and time.monotonic() < until:
            time.sleep(0.02)
        return Desk(f"http://{host}/{TOKEN}/", host, folder, photo or Path())

    yield start
    for server, thread in servers:
        server.should_exit = True
        thread.join(10)


@pytest.fixture(scope="session")
def desk(serve, photo_file) -> Desk:
    return serve(photo_file)


@pytest.fixture(scope="session")
def empty_desk(serve) -> Desk:
    return serve(None)


@pytest.fixture(scope="session")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def profile(browser):
    """Yield a browser with nothing stored."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, accept_downloads=True)
    yield context
    context.close()
