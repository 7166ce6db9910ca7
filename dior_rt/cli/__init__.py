"""The command line, `dior-rt`. What goes wrong for a known reason is one sentence and exit code 2.

Nothing heavy is imported before a command's body runs: `dior-rt --help` loads neither NumPy nor ONNX Runtime.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import NoReturn

import typer

from dior_rt.errors import DiorError


def main() -> NoReturn:
    """The console script."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Carry out a command line and return its exit code: 0, 2 for what the user can mend, 130 for Ctrl-C."""
    from dior_rt.cli.app import app

    command = typer.main.get_command(app)
    try:
        return command.main(list(arguments), prog_name="dior-rt", standalone_mode=False) or 0
    except typer.TyperException as error:  # an option or argument that does not parse
        problem = error.format_message()
    except typer.Abort:
        return 130
    except MemoryError:
        problem = "There is not enough memory for this; try a smaller photo."
    except DiorError as error:
        # Looked up here, for a command may fail before its options are known.
        if "--debug" in arguments:
            traceback.print_exception(error)
        problem = str(error)
    sentence = " ".join(problem.split()).rstrip(".")
    print(f"dior-rt: {sentence}.", file=sys.stderr)
    return 2
