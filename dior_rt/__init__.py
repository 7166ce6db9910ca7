"""Dior relights a photograph from light that a person draws on it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from dior_rt import _clone

if TYPE_CHECKING:
    from dior_rt.relight import Relighter as Relighter

_clone.install()

# ONNX Runtime from 1.29 on sends reports to its maker, keeps an identifier in the user's cache and makes DNS
# queries, unless one of these is set before it is imported. Users who want the reports set them to 0.
for _name in ("ORT_DISABLE_TELEMETRY", "ORT_TELEMETRY_DISABLED"):
    os.environ.setdefault(_name, "1")

__version__ = "0.1.0"
__all__ = ["Relighter", "__version__"]


def __getattr__(name: str) -> Any:
    # ONNX Runtime is loaded only for relighting, so importing only dior_rt.kernels stays fast.
    if name == "Relighter":
        from dior_rt.relight import Relighter

        return Relighter
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
