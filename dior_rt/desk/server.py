"""Run the desk on this machine until it is stopped."""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Final

import uvicorn

from dior_rt.desk.app import make_app
from dior_rt.desk.guard import new_token
from dior_rt.desk.studio import Studio
from dior_rt.errors import InputError
from dior_rt.files import reason
from dior_rt.relight import Relighter

HOST: Final = "127.0.0.1"

#: The default port. Browsers store drawings by port, so it should be the same each time.
USUAL_PORT: Final = 8642


def run_desk(
    load: Callable[[], Relighter],
    photo: Path | None,
    port: int | None,
    browse: bool,
    say: Callable[[str], None],
) -> None:
    """Serve the desk on the loopback interface until Ctrl-C.

    load: the function that makes the model. photo: the photo to begin with. port: 0 takes a free one; None
    takes USUAL_PORT, or a free one where that is taken. browse: whether to open the page. say: the function
    that is called with the link. Raises InputError for a port that is taken.
    """
    token = new_token()
    with _listen(port) as listener, tempfile.TemporaryDirectory(prefix="dior-desk-") as folder:
        port = listener.getsockname()[1]
        hosts = frozenset(f"{name}:{port}" for name in (HOST, "localhost"))
        app = make_app(Studio(load, Path(folder)), token, hosts, photo)
        link = f"http://{HOST}:{port}/{token}/"
        say(link)
        if browse:
            webbrowser.open(link)
        config = uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=3)
        with contextlib.suppress(KeyboardInterrupt):
            uvicorn.Server(config).run([listener])


def _listen(port: int | None) -> socket.socket:
    if port is None:
        with contextlib.suppress(InputError):
            return _listen(USUAL_PORT)
    listener = socket.socket()
    try:
        if os.name != "nt":  # on Windows it would let two programs share the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port or 0))
        listener.listen()  # now, so that a browser that follows the link at once is not refused
        return listener
    except (OSError, OverflowError) as error:
        listener.close()
        raise InputError(
            f"Cannot listen on port {port}: {reason(error)}. Use --port 0 for a free one."
        ) from error
