"""The command line, `dior-rt`. An expected error is reported in one sentence, with exit code 2.

Nothing heavy is imported before a command's body runs: `dior-rt --help` loads neither NumPy nor ONNX Runtime.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

import typer

from dior_rt.errors import DiorError

WRONG_USE, UNEXPECTED, INTERRUPTED = 2, 70, 130  # 70 is EX_SOFTWARE of sysexits.h


def main() -> NoReturn:
    """Run the console script."""
    _repair_streams()
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:  # ignored under nohup
            signal.signal(number, _stop)
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code.

    The code is 0 for success, 2 for an error that the user can correct, 70 for an unexpected error, and 130
    for Ctrl-C.
    """
    caught: Exception
    try:
        return _run(arguments)
    except DiorError as error:
        problem, code, caught = str(error), WRONG_USE, error
    except MemoryError as error:
        problem, code, caught = "There is not enough memory for this; try a smaller photo.", WRONG_USE, error
    except Exception as error:
        problem, code, caught = _unexpected(error), UNEXPECTED, error
    # The option is looked up here, because a command may fail before its options are parsed.
    if "--debug" in arguments and sys.stderr is not None:
        traceback.print_exception(caught)
    return _refuse(problem, code)


def _run(arguments: Sequence[str]) -> int:
    from dior_rt.cli.app import app

    command = typer.main.get_command(app)
    try:
        return command.main(list(arguments), prog_name="dior-rt", standalone_mode=False) or 0
    except typer.TyperException as error:  # an option or argument cannot be parsed
        return _refuse(error.format_message(), WRONG_USE)
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED


def _refuse(problem: str, code: int) -> int:
    sentence = " ".join(problem.split()).rstrip(".")
    if sys.stderr is not None:
        print(f"dior-rt: {sentence}.", file=sys.stderr)
    return code


def _unexpected(error: Exception) -> str:
    """Return a sentence for an error that no part of the program translated."""
    text = " ".join(str(error).split())
    told = f"{type(error).__name__}: {text:.200}" if text else type(error).__name__
    return f"Something went wrong that was not foreseen ({told}); --debug shows the details"


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Stop as the signal asks, but run every `finally`, so that no half-written file remains."""
    raise SystemExit(128 + number)


def _repair_streams() -> None:
    """Open the streams that the shell has closed (`2>&-`), and make them able to print any file name.

    Otherwise the next opened file would become the standard error and receive a library's messages.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            nothing = os.open(os.devnull, os.O_RDWR)
            if nothing != descriptor:
                os.dup2(nothing, descriptor)
                os.close(nothing)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
