"""Dior relights a photograph from light that a person draws on it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dior_rt import _clone

if TYPE_CHECKING:
    from dior_rt.relight import Relighter as Relighter

_clone.install()

__version__ = "0.1.0"
__all__ = ["Relighter", "__version__"]


def __getattr__(name: str) -> Any:
    # ONNX Runtime is loaded only by those who relight: importing dior_rt.kernels alone stays light.
    if name == "Relighter":
        from dior_rt.relight import Relighter

        return Relighter
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
