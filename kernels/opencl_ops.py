"""Every operation on an OpenCL device: which kernels run on which bands. The .cl files compute."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyopencl as cl

from dior_rt.kernels import draw
from dior_rt.kernels.color import decode_table, encode_table
from dior_rt.kernels.ops import Grid, Ops
from dior_rt.kernels.resample import FAINTEST, bands, spline_taps
from dior_rt.kernels.session import Session
from dior_rt.kernels.sparsify import Discs, Lattice, spans
from dior_rt.kernels.transfer import EPSILON, SIGMA
from dior_rt.kernels.types import Device, FloatArray, Picture, Stroke, Strokes

#: The names of the sample dtypes in OpenCL C.
SAMPLES = {"uint8": "uchar", "uint16": "ushort", "float32": "float"}
#: Pixels in a band: a few megabytes, and enough work that the cost of a launch does not matter.
BAND = 1 << 22
#: Below this many vector registers per cell, the partly filled last one wastes more than a fifth of the time.
FEW = 4


class OpenCLOps(Ops):
    """The operations on one OpenCL device. Safe to call from several threads."""

    def __init__(self, device: Device) -> None:
        """Open the device. Raises KernelError if that fails."""
        self._session = Session(device)
        self.name = self._session.name

    def _decode(self, picture: Picture) -> FloatArray:
        linear = np.empty(picture.shape, np.float32)
        if picture.dtype == np.float32:
            self._map(self._kernel("decode_floats"), picture, linear)
        else:
            table = self._session.constant(decode_table(picture.dtype))
            self._map(self._kernel("decode", picture.dtype), picture, linear, table)
        return linear

    def _encode(self, linear: FloatArray, dtype: np.dtype) -> Picture:
        picture = np.empty(linear.shape, dtype)
        if dtype == np.float32:
            self._map(self._kernel("encode_floats"), linear, picture)
        else:
            table = self._session.constant(encode_table(dtype).entry)
            self._map(self._kernel("encode", dtype), linear, picture, table)
        return picture

    def _map(self, kernel: cl.Kernel, buffers: np.ndarray, result: np.ndarray, *table: cl.Buffer) -> None:
        """Run an elementwise kernel from one array to another of the same shape."""
        session, flat, out = self._session, buffers.reshape(-1), result.reshape(-1)
        for band in bands(flat.size, 1, BAND):
            size = band.stop - band.start
            with session.output(out[band]) as buffer:
                session.launch(kernel, size, 1, session.input(flat[band]), *table, buffer, size)

    def _reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray:
        kernel = self._kernel("sum_photo", picture.dtype)
        table = self._decode_table(picture.dtype)
        return self._reduce(kernel, [picture], table, 3, picture.shape[:2], grid).light

    def _reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes:
        if light.dtype == mask.dtype == np.float32:
            kernel = self._kernel("sum_strokes")
        else:
            # Strokes in float are linear already.
            types = {
                "LIGHT": SAMPLES[light.dtype.name],
                "DECODE_LIGHT": "" if light.dtype == np.float32 else "DECODE",
                "MASK": SAMPLES[mask.dtype.name],
                "MASK_WHOLE": _whole(mask.dtype),
            }
            kernel = self._kernel("sum_strokes", light.dtype, **types)
        return self._reduce(kernel, [light, mask], self._decode_table(light.dtype), 4, mask.shape, grid)

    def _reduce(
        self,
        kernel: cl.Kernel,
        pictures: list[Picture],
        table: cl.Buffer | None,
        channels: int,
        size: Grid,
        grid: Grid,
    ) -> Strokes:
        session, (height, width), (rows, columns) = self._session, size, grid
        result = Strokes(np.empty((*grid, 3), np.float32), np.empty(grid, np.float32))
        # Photos are summed by samples, strokes by pixels.
        count = width * 3 if channels == 3 else width
        sums = session.scratch(rows * width * channels * 4)
        session.clear(sums)
        for band in bands(height, width, BAND):
            buffers = [session.input(picture[band]) for picture in pictures]
            session.launch(
                kernel, count, rows, *buffers, table, sums, count, height, rows, band.start, band.stop
            )
        mean_cells = self._kernel("mean_cells")
        with session.output(result.light) as light, session.output(result.mask) as specified:
            session.launch(mean_cells, columns, rows, sums, light, specified, channels, width, columns)
        return result

    def _draw_strokes(self, strokes: list[Stroke], size: Grid) -> Strokes:
        session, (height, width) = self._session, size
        result = Strokes(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32))
        if not strokes:
            return result
        plan, columns = draw.plan(strokes, size), -(-width // draw.TILE)
        kernel = self._kernel("draw")
        buffers = [session.input(array) for array in (plan.segments, plan.lights, plan.first, plan.entries)]
        for band in bands(height, width, BAND):
            with session.output(result.light[band]) as light, session.output(result.mask[band]) as mask:
                session.launch(
                    kernel, columns, band.stop - band.start, *buffers, light, mask, width, columns, band.start
                )
        return result

    def _coarsen(self, lumi: FloatArray, lattice: Lattice) -> Strokes:
        session, (height, width), (rows, columns) = self._session, lumi.shape[:2], lattice.keep.shape
        result = Strokes(np.empty(lumi.shape, np.float32), np.empty((height, width), np.float32))
        buffers = session.input(lumi), session.input(lattice.keep.astype(np.uint8))
        place = lattice.cell, lattice.oy, lattice.ox
        with session.output(result.light) as light, session.output(result.mask) as mask:
            kernel = self._kernel("coarsen")
            session.launch(kernel, columns, rows, *buffers, light, mask, height, width, *place, columns)
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
        tables = self._decode_table(photo.dtype), self._encode_table(photo.dtype)
        narrow = width < columns * session.lanes * FEW
        kernel = self._kernel("transfer_narrow" if narrow else "transfer", photo.dtype)
        light = _by_pixel(nodes, width) if narrow else (nodes,)
        buffers = [*map(session.input, light), *tables]
        count, sides = (width, ()) if narrow else (columns, (columns,))
        for band in bands(height, width, BAND):
            with session.output(result[band]) as out:
                place = height, width, rows, *sides, band.start
                taken = session.input(photo[band])
                session.launch(kernel, count, band.stop - band.start, taken, *buffers, out, *place)
        return result

    def _kernel(self, name: str, dtype: npt.DTypeLike = np.uint8, **defines: str) -> cl.Kernel:
        """Return a kernel for samples of that dtype. Strokes are floats unless `defines` says otherwise."""
        kind = np.dtype(dtype)
        macros = {
            "SAMPLE": SAMPLES[kind.name],
            "WHOLE": _whole(kind),
            "TOP": "0",
            "LIGHT": "float",
            "DECODE_LIGHT": "",
            "MASK": "float",
            "MASK_WHOLE": "1.0f",
            "FAINTEST": f"{FAINTEST}f",
            "EPSILON": f"{EPSILON}f",
            "SIGMA": f"{SIGMA}f",
            "TILE": f"{draw.TILE}",
            "LANES": f"{self._session.lanes}",
        }
        if kind != np.float32:
            table = encode_table(kind)
            macros["TOP"] = f"{np.iinfo(kind).max}"
            macros |= {"SHIFT": f"{table.shift}", "FLOOR": f"{table.floor:.9g}f"}
        return self._session.kernel(name, **macros | defines)

    def _decode_table(self, dtype: np.dtype) -> cl.Buffer | None:
        return None if dtype == np.float32 else self._session.constant(decode_table(dtype))

    def _encode_table(self, dtype: np.dtype) -> cl.Buffer | None:
        return None if dtype == np.float32 else self._session.constant(encode_table(dtype).entry)


def _by_pixel(nodes: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Return the nodes before, at and after every pixel of a row, and their weights.

    Shapes: (rows + 2, 3, 4, width) and (3, width).
    """
    column, across = spline_taps(width, nodes.shape[1] - 2)
    planes = np.ascontiguousarray(nodes.transpose(0, 2, 1))  # (rows + 2, 4, columns + 2)
    return np.stack([planes.take(column + m, axis=2) for m in range(3)], 1), across


def _whole(dtype: np.dtype) -> str:
    """Return the value that represents 1 in samples of that dtype, as OpenCL C."""
    return "1.0f" if dtype == np.float32 else f"{np.iinfo(dtype).max}.0f"
