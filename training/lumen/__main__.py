"""`python -m dior_rt.training.lumen`: pack views and train; needs torch, Pillow, safetensors and typer."""

from __future__ import annotations

import sys

from dior_rt.errors import DiorError
from dior_rt.training.lumen.command import app

if __name__ == "__main__":
    try:
        app()
    except DiorError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
