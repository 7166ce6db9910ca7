"""Turn trained weights into a bundle: merge, convert, check. Imported as `dior_rt.export`; needs the
extra."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dior_rt.export.mini import export_checkpoint as export_checkpoint

__all__ = ["export_checkpoint"]


def __getattr__(name: str) -> Any:
    # Qwen's export is in this package too, and does not need mini's training code.
    if name == "export_checkpoint":
        from dior_rt.export.mini import export_checkpoint

        return export_checkpoint
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
