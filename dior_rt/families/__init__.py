"""The model families: each turns a photo and strokes into network inputs, and network outputs into light.

A bundle names its family. `mini`, `lumen` and `qwen` are built in. Any installed package can add a family
with an entry point of the group `dior_rt.families`, whose value is a callable
`(bundle, device, threads) -> Family`:

    [project.entry-points."dior_rt.families"]
    watercolour = "my_package.family:Watercolour"
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final, Literal, Protocol, TypeVar

from numpy.typing import NDArray

from dior_rt.bundle import Bundle
from dior_rt.errors import BundleError
from dior_rt.flow.sampler import Array, Velocity
from dior_rt.kernels import Ops, Strokes

Mode = Literal["relight", "estimate"]
C = TypeVar("C")

#: Entry points of this group add families.
GROUP: Final = "dior_rt.families"
#: The built-in families: name -> module and class, imported when a bundle needs them.
BUILT_IN: Final = {
    "mini": "dior_rt.families.mini:Mini",
    "lumen": "dior_rt.families.lumen:Lumen",
    "qwen": "dior_rt.families.qwen.model:Qwen",
}


class Family(Protocol[C]):
    """A bundle of one family, loaded on a device and safe to use from several threads. C is its condition.

    device, reason: the device that runs the networks, and why it was chosen.
    """

    device: str
    reason: str

    def raster(self, height: int, width: int) -> tuple[int, int]:
        """Return the (rows, columns) on which light is predicted for a photo of height x width pixels."""

    def reduce_photo(self, pixels: NDArray, raster: tuple[int, int], ops: Ops) -> tuple[Array, Array]:
        """Return a photo (H, W, 3), sRGB, on its raster (h, w, 3): in linear light, and sRGB-encoded 0..1."""

    def encode(self, photo: Array, strokes: Strokes | None, mode: Mode) -> C:
        """Return the condition for a photo (h, w, 3), sRGB 0..1, and strokes on the same raster."""

    def noise_shape(self, condition: C) -> tuple[int, ...]:
        """Return the shape of the flow's state."""

    def sigmas(self, steps: int, condition: C) -> Array:
        """Return the flow times of the bundle's schedule: steps + 1 values, falling from 1 to 0."""

    def velocity(self, condition: C, sigmas: Array, guidance: float) -> Velocity:
        """Return the guided velocity at those flow times: guidance 1 is the condition alone, 0 no strokes."""

    def decode_relit(self, x0: Array, condition: C) -> Array:
        """Return the relit raster (h, w, 3), sRGB-encoded, >= 0; 1 is display white."""

    def decode_lumi(self, x0: Array, condition: C) -> Array:
        """Return the estimated Lumi map of the raster (h, w, 3), linear >= 0."""


Opener = Callable[[Bundle, str, "int | None"], Family[Any]]


def open_family(bundle: Bundle, device: str, threads: int | None) -> Family[Any]:
    """Load a bundle's networks on a device.

    Raises BundleError for a family that is not installed, and the errors of the family.
    """
    return _find(bundle)(bundle, device, threads)


def family_names() -> tuple[str, ...]:
    """Return the names of all families that are installed, the built-in ones first."""
    return tuple(dict.fromkeys((*BUILT_IN, *(point.name for point in entry_points(group=GROUP)))))


def _find(bundle: Bundle) -> Opener:
    name = bundle.manifest.family
    if name in BUILT_IN:
        module, _, attribute = BUILT_IN[name].partition(":")
        return getattr(import_module(module), attribute)
    found: EntryPoint | None = next(iter(entry_points(group=GROUP, name=name)), None)
    if found is None:
        raise BundleError(
            f"The bundle {bundle.folder} is of the family {name!r}, which is not installed; "
            f"installed families: {', '.join(family_names())}."
        )
    try:
        return found.load()
    except (ImportError, AttributeError) as error:
        raise BundleError(f"The family {name!r} cannot be loaded from {found.value}: {error}.") from error
