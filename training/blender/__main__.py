"""`python -m dior_rt.training.blender`: make the asset folder and render views."""

from __future__ import annotations

import sys

from dior_rt.errors import DiorError
from dior_rt.training.blender.command import app

if __name__ == "__main__":
    try:
        app()
    except DiorError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
