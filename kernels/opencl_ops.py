"""The kernels on an OpenCL device: what is launched, on which bands. The arithmetic stands in the .cl files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from dior_rt.kernels import draw
from dior_rt.kernels.color import decode_table, encode_table
from dior_rt.kernels.ops import Grid, Ops
from dior_rt.kernels.resample import bands
from dior_rt.kernels.session import Session
from dior_rt.kernels.sparsify import Discs, Lattice, spans
from dior_rt.kernels.transfer import EPSILON, SIGMA
from dior_rt.kernels.types import FloatArray, Picture, Stroke, Strokes

if TYPE_CHECKING:
    from dior_rt.kernels.devices import Device

SAMPLES = {"uint8": "uchar", "uint16": "ushort", "float32": "float"}
#: Samples in a row that one work item of `decode` and `encode` takes: a CPU wants few long loops, a GPU many items.
CPU_RUN, GPU_RUN = 4096, 1


class OpenCLOps(Ops):
    """The operations on one device. Safe to call from several threads."""

    def __init__(self, device: Device) -> None:
        """Raises KernelError if the device cannot be opened."""
        self._session = Session(device)
        self.name = self._session.name
        self._run = CPU_RUN if device.type == "cpu" else GPU_RUN

    def _decode(self, picture: Picture) -> FloatArray:
        linear = np.empty(picture.shape, np.float32)
        kernel = self._curve("decode", "curve", picture.dtype)
        self._map(kernel, picture, linear, self._decode_table(picture.dtype))
        return linear

    def _encode(self, linear: FloatArray, dtype: np.dtype) -> Picture:
        picture = np.empty(linear.shape, dtype)
        self._map(self._curve("encode", "curve", dtype), linear, picture, *self._encode_tables(dtype))
        return picture

    def _reduce_photo(self, picture: Picture, grid: Grid) -> FloatArray:
        kernel = self._curve("sum_rows", "curve reduce", picture.dtype, LIGHT="DECODE")
        return self._reduce(kernel, picture, None, grid).light

    def _reduce_strokes(self, light: Picture, mask: Picture, grid: Grid) -> Strokes:
        # Strokes' floats are linear already.
        linear = {"LIGHT": ""} if light.dtype == np.float32 else {"LIGHT": "DECODE"}
        whole = 1 if mask.dtype == np.float32 else np.iinfo(mask.dtype).max
        kernel = self._curve(
            "sum_rows",
            "curve reduce",
            light.dtype,
            MASK=SAMPLES[mask.dtype.name],
            WHOLE=f"{whole}.0f",
            **linear,
        )
        return self._reduce(kernel, light, mask, grid)

    def _reduce(self, sum_rows: cl.Kernel, picture: Picture, mask: Picture | None, grid: Grid) -> Strokes:
        session, (height, width), (rows, columns) = self._session, picture.shape[:2], grid
        result = Strokes(np.empty((*grid, 3), np.float32), np.empty(grid, np.float32))
        sums = session.scratch(height * columns * 16)
        table = self._decode_table(picture.dtype)
        for band in bands(height, width):
            given = [] if mask is None else [session.input(mask[band])]
            session.launch(
                sum_rows, (columns, band.stop - band.start), session.input(picture[band]), table, *given, sums,
                width, columns, band.start,
            )  # fmt: skip
        mean_columns = session.kernel("mean_columns", "reduce")
        with session.output(result.light) as light, session.output(result.mask) as specified:
            session.launch(mean_columns, (columns, rows), sums, light, specified, height)
        return result

    def _draw_strokes(self, strokes: list[Stroke], size: Grid) -> Strokes:
        session, (height, width) = self._session, size
        result = Strokes(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32))
        if not strokes:
            return result
        plan = draw.Plan(strokes, size)
        kernel = session.kernel("draw", "draw", TILE=draw.TILE)
        plans = [session.input(array) for array in (plan.segments, plan.lights, plan.first, plan.entries)]
        for band in bands(height, width):
            with session.output(result.light[band]) as light, session.output(result.mask[band]) as mask:
                items = (-(-width // draw.TILE), band.stop - band.start)
                session.launch(kernel, items, *plans, light, mask, width, band.start)
        return result

    def _coarsen(self, lumi: FloatArray, lattice: Lattice) -> Strokes:
        session, (height, width) = self._session, lumi.shape[:2]
        result = Strokes(np.empty(lumi.shape, np.float32), np.empty((height, width), np.float32))
        rows, columns = lattice.keep.shape
        with session.output(result.light) as light, session.output(result.mask) as mask:
            session.launch(
                session.kernel("coarsen", "sparsify"), (columns, rows), session.input(lumi),
                session.input(lattice.keep.astype(np.uint8)), light, mask,
                height, width, lattice.cell, lattice.oy, lattice.ox,
            )  # fmt: skip
        return result

    def _cut(self, lumi: FloatArray, discs: Discs) -> Strokes:
        session, (height, width) = self._session, lumi.shape[:2]
        result = Strokes(np.empty(lumi.shape, np.float32), np.zeros((height, width), np.float32))
        row, first, stop = spans(discs, height, width)
        with session.output(result.mask) as mask:
            begin, end = session.input(row * width + first), session.input(row * width + stop)
            session.launch(session.kernel("cover", "sparsify"), (row.size,), begin, end, mask)
        with session.output(result.light) as light:
            mask = session.input(result.mask)
            session.launch(
                session.kernel("cut", "sparsify"), (width, height), session.input(lumi), mask, light
            )
        return result

    def _transfer(self, photo: Picture, nodes: FloatArray) -> Picture:
        session, (height, width) = self._session, photo.shape[:2]
        rows, columns = nodes.shape[0] - 2, nodes.shape[1] - 2
        result = np.empty(photo.shape, photo.dtype)
        scale = 1 if photo.dtype == np.float32 else np.iinfo(photo.dtype).max
        kernel = self._curve(
            "transfer", "curve transfer", photo.dtype,
            SCALE=f"{scale}.0f", EPSILON=f"{EPSILON}f", SIGMA=f"{SIGMA}f",
        )  # fmt: skip
        constants = [session.input(nodes), self._decode_table(photo.dtype), *self._encode_tables(photo.dtype)]
        for band in bands(height, width):
            with session.output(result[band]) as out:
                items = (columns, band.stop - band.start)
                session.launch(
                    kernel,
                    items,
                    session.input(photo[band]),
                    *constants,
                    out,
                    height,
                    width,
                    rows,
                    band.start,
                )
        return result

    def _curve(self, name: str, sources: str, dtype: np.dtype, **defines: object) -> cl.Kernel:
        """A kernel for samples of that dtype."""
        integer = dtype != np.float32
        top = np.iinfo(dtype).max if integer else 0
        floor = f"{float(encode_table(dtype).floor):.9g}f" if integer else "0.0f"
        return self._session.kernel(
            name, sources, SAMPLE=SAMPLES[dtype.name], TOP=top, FLOOR=floor, **defines
        )

    def _decode_table(self, dtype: np.dtype) -> cl.Buffer | None:
        return None if dtype == np.float32 else self._session.constant(decode_table(dtype))

    def _encode_tables(self, dtype: np.dtype) -> tuple[cl.Buffer | None, cl.Buffer | None]:
        if dtype == np.float32:
            return None, None
        table = encode_table(dtype)
        return self._session.constant(table.start), self._session.constant(table.threshold)

    def _map(
        self, kernel: cl.Kernel, source: np.ndarray, target: np.ndarray, *tables: cl.Buffer | None
    ) -> None:
        """Run an elementwise kernel from one array to another of the same shape, band by band."""
        flat, out = source.reshape(-1), target.reshape(-1)
        for part in bands(flat.size, 3):
            size = part.stop - part.start
            with self._session.output(out[part]) as result:
                items = (-(-size // self._run),)
                given = self._session.input(flat[part])
                self._session.launch(kernel, items, given, *tables, result, size, self._run)
