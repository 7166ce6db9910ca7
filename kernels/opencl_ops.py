"""The kernels on an OpenCL device: what is launched, on which bands. Their arithmetic is in the .cl files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from dior_rt.kernels import draw
from dior_rt.kernels.color import decode_table, encode_table
from dior_rt.kernels.ops import Grid, Ops
from dior_rt.kernels.resample import FAINTEST, bands
from dior_rt.kernels.session import Session
from dior_rt.kernels.sparsify import Discs, Lattice, spans
from dior_rt.kernels.transfer import EPSILON, SIGMA
from dior_rt.kernels.types import FloatArray, Picture, Stroke, Strokes

if TYPE_CHECKING:
    from dior_rt.kernels.devices import Device

#: How a sample's dtype is called in OpenCL C.
SAMPLES = {"uint8": "uchar", "uint16": "ushort", "float32": "float"}
#: Pixels in a band: a few megabytes, and enough work to make a launch's cost vanish.
BAND = 1 << 22


class OpenCLOps(Ops):
    """The operations on one device. Safe to call from several threads."""

    def __init__(self, device: Device) -> None:
        """Raises KernelError if the device cannot be opened."""
        self._session = Session(device)
        self.name = self._session.name

    def _decode(self, picture: Picture) -> FloatArray:
        linear = np.empty(picture.shape, np.float32)
        self._map(self._kernel("decode", picture.dtype), picture, linear, self._decode_table(picture.dtype))
        return linear

    def _encode(self, linear: FloatArray, dtype: np.dtype) -> Picture:
        picture = np.empty(linear.shape, dtype)
        self._map(self._kernel("encode", dtype), linear, picture, self._encode_table(dtype))
        return picture

    def _map(self, kernel: cl.Kernel, given: np.ndarray, result: np.ndarray, table: cl.Buffer | None) -> None:
        """Run an elementwise kernel from one array to another of the same shape."""
        session, flat, out = self._session, given.reshape(-1), result.reshape(-1)
        for band in bands(flat.size, 1, BAND):
            size = band.stop - band.start
            with session.output(out[band]) as buffer:
                session.launch(kernel, size, 1, session.input(flat[band]), table, buffer, size)

    def _reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray:
        return self._reduce(self._kernel("sum_rows", picture.dtype), picture, None, grid).light

    def _reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes:
        # The floats of strokes are linear already.
        decode = "" if light.dtype == np.float32 else "DECODE"
        masked = {"MASK": SAMPLES[mask.dtype.name], "MASK_WHOLE": _whole(mask.dtype), "LIGHT": decode}
        masked["FAINTEST"] = f"{FAINTEST}f"
        return self._reduce(self._kernel("sum_rows", light.dtype, **masked), light, mask, grid)

    def _reduce(self, sum_rows: cl.Kernel, picture: Picture, mask: Picture | None, grid: Grid) -> Strokes:
        session, (height, width), (rows, columns) = self._session, picture.shape[:2], grid
        result = Strokes(np.empty((*grid, 3), np.float32), np.empty(grid, np.float32))
        table, sums = self._decode_table(picture.dtype), session.scratch(height * columns * 16)
        for band in bands(height, width, BAND):
            pixels = [session.input(picture[band]), table]
            if mask is not None:
                pixels.append(session.input(mask[band]))
            session.launch(
                sum_rows, columns, band.stop - band.start, *pixels, sums, width, columns, band.start
            )
        mean_columns = self._kernel("mean_columns")
        with session.output(result.light) as light, session.output(result.mask) as specified:
            session.launch(mean_columns, columns, rows, sums, light, specified, height, rows, columns)
        return result

    def _draw_strokes(self, strokes: list[Stroke], size: Grid) -> Strokes:
        session, (height, width) = self._session, size
        result = Strokes(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32))
        if not strokes:
            return result
        plan, columns = draw.plan(strokes, size), -(-width // draw.TILE)
        kernel = self._kernel("draw")
        given = [session.input(array) for array in (plan.segments, plan.lights, plan.first, plan.entries)]
        for band in bands(height, width, BAND):
            with session.output(result.light[band]) as light, session.output(result.mask[band]) as mask:
                session.launch(
                    kernel, columns, band.stop - band.start, *given, light, mask, width, columns, band.start
                )
        return result

    def _coarsen(self, lumi: FloatArray, lattice: Lattice) -> Strokes:
        session, (height, width), (rows, columns) = self._session, lumi.shape[:2], lattice.keep.shape
        result = Strokes(np.empty(lumi.shape, np.float32), np.empty((height, width), np.float32))
        given = session.input(lumi), session.input(lattice.keep.astype(np.uint8))
        place = lattice.cell, lattice.oy, lattice.ox
        with session.output(result.light) as light, session.output(result.mask) as mask:
            kernel = self._kernel("coarsen")
            session.launch(kernel, columns, rows, *given, light, mask, height, width, *place, columns)
        return result

    def _cut(self, lumi: FloatArray, discs: Discs) -> Strokes:
        session, (height, width) = self._session, lumi.shape[:2]
        result = Strokes(np.empty(lumi.shape, np.float32), np.empty((height, width), np.float32))
        row, first, stop = spans(discs, height, width)
        drawn = session.input(row * width + first), session.input(row * width + stop)
        with session.output(result.light) as light, session.output(result.mask) as mask:
            session.clear(mask)
            session.launch(self._kernel("cover"), row.size, 1, *drawn, mask, row.size)
            kernel, size = self._kernel("cut"), height * width
            session.launch(kernel, size, 1, session.input(lumi), mask, light, size)
        return result

    def _transfer(self, photo: Picture, nodes: FloatArray) -> Picture:
        session, (height, width) = self._session, photo.shape[:2]
        rows, columns = nodes.shape[0] - 2, nodes.shape[1] - 2
        result = np.empty(photo.shape, photo.dtype)
        kernel = self._kernel("transfer", photo.dtype)
        tables = self._decode_table(photo.dtype), self._encode_table(photo.dtype)
        given = session.input(nodes), *tables
        for band in bands(height, width, BAND):
            with session.output(result[band]) as out:
                place = height, width, rows, columns, band.start
                count = band.stop - band.start
                session.launch(kernel, columns, count, session.input(photo[band]), *given, out, *place)
        return result

    def _kernel(self, name: str, dtype: npt.DTypeLike = np.uint8, **defines: str) -> cl.Kernel:
        """A kernel for samples of that dtype."""
        kind = np.dtype(dtype)
        curve = {"SAMPLE": SAMPLES[kind.name], "WHOLE": _whole(kind), "TOP": "0"}
        if kind != np.float32:
            table = encode_table(kind)
            curve |= {
                "TOP": f"{np.iinfo(kind).max}",
                "SHIFT": f"{table.shift}",
                "FLOOR": f"{table.floor:.9g}f",
            }
        constants = {"EPSILON": f"{EPSILON}f", "SIGMA": f"{SIGMA}f", "TILE": f"{draw.TILE}"}
        constants["LANES"] = f"{self._session.lanes}"
        return self._session.kernel(name, **curve, **constants, **defines)

    def _decode_table(self, dtype: np.dtype) -> cl.Buffer | None:
        return None if dtype == np.float32 else self._session.constant(decode_table(dtype))

    def _encode_table(self, dtype: np.dtype) -> cl.Buffer | None:
        return None if dtype == np.float32 else self._session.constant(encode_table(dtype).entry)


def _whole(dtype: np.dtype) -> str:
    """What stands for 1 in samples of that dtype."""
    return "1.0f" if dtype == np.float32 else f"{np.iinfo(dtype).max}.0f"
