"""The pixel kernels: OpenCL C, their host code, and a NumPy twin of each. Imported as ``dior_rt.kernels``.

ops = open_ops("auto")
grid = ops.reduce_photo(photo, (64, 64))
"""

from __future__ import annotations

from dior_rt.kernels.numpy_ops import NumpyOps
from dior_rt.kernels.ops import Ops
from dior_rt.kernels.types import KernelError, Stroke, Strokes

__all__ = ["KernelError", "NumpyOps", "Ops", "Stroke", "Strokes"]
