"""The command that opens the light desk."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dior_rt.cli import options
from dior_rt.extras import needs_extra

if TYPE_CHECKING:
    from dior_rt.relight import Relighter


def desk(
    photo: Annotated[
        Path | None,
        typer.Argument(metavar="[PHOTO]", help="A photo to begin with; the page opens others too."),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="The port; 0 takes a free one [default: 8642, or a free one]."),
    ] = None,
    browser: Annotated[
        bool,
        typer.Option("--browser/--no-browser", help="Open the page in the browser, or print its link only."),
    ] = True,
    bundle: options.Bundle = None,
    device: options.Device = "auto",
    ops: options.Ops = "auto",
    debug: options.Debug = False,
) -> None:
    """Draw light on a photo in the browser, and see it at once.

    The page runs on this machine and speaks to this machine alone: the link that is printed holds a token,
    and nothing else is answered. Ctrl-C closes the desk. Needs pip install 'dior-rt[desk]'.

    \b
      dior-rt desk photo.jpg
      dior-rt desk --no-browser --port 8700
    """
    with needs_extra("desk"):
        from dior_rt.desk.server import run_desk
    if photo:
        from dior_rt.files import check_readable

        check_readable(photo, "photo")

    def load() -> Relighter:
        from dior_rt.relight import Relighter

        return Relighter(bundle, device, ops)

    run_desk(load, photo, port, browser, lambda link: typer.echo(f"The light desk is open at {link}"))
