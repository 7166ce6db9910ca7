"""Dior relights a photograph from light that a person draws on it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from dior_rt import _clone

if TYPE_CHECKING:
    from dior_rt.relight import Relighter as Relighter

_clone.install()

# ONNX Runtime from 1.29 on reports to its maker, keeps an identifier in the user's cache and looks names up,
# unless one of these is set before it is imported. Whoever wants that sets them to 0.
for _name in ("ORT_DISABLE_TELEMETRY", "ORT_TELEMETRY_DISABLED"):
    os.environ.setdefault(_name, "1")

__version__ = "0.1.0"
__all__ = ["Relighter", "__version__"]


def __getattr__(name: str) -> Any:
    # ONNX Runtime is loaded only by those who relight: importing dior_rt.kernels alone stays light.
    if name == "Relighter":
        from dior_rt.relight import Relighter

        return Relighter
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
