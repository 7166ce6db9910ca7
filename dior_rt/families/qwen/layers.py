"""Run graphs one after another. As many as fit in memory stay loaded; the others are loaded for each use.

So a model larger than memory still runs, only slower.
"""

from __future__ import annotations

import threading
from pathlib import Path

from numpy.typing import NDArray

from dior_rt.bundle import Bundle
from dior_rt.engine import Engine, Feeds, open_engine

SHARE = 0.7  # share of the free memory for weights; the rest is for activations


class Layers:
    """The graphs of a bundle on one device, by name. Safe to use from several threads.

    device, reason: the device that runs them, and why. memory: bytes of weights that may stay loaded.
    """

    def __init__(
        self,
        bundle: Bundle,
        first: str,
        device: str = "auto",
        threads: int | None = None,
        memory: int | None = None,
    ) -> None:
        """Open the graph `first`, which decides on the device. memory: None takes a share of the free memory.

        Raises what `open_engine` raises.
        """
        self._bundle, self._threads = bundle, threads
        self.memory = _free_memory() * SHARE if memory is None else memory
        engine = open_engine(bundle, first, device, threads, keep=False)
        self.device, self.reason = engine.device, engine.reason
        self._kept = {first: engine}
        self._bytes = self.size(first)
        self._lock = threading.Lock()

    def run(self, name: str, feeds: Feeds) -> dict[str, NDArray]:
        """Run one graph; raises what `Engine.run` raises."""
        return self.engine(name).run(feeds)

    def engine(self, name: str) -> Engine:
        """Return the graph's engine. Do not keep it longer than needed, because it keeps the weights in
        memory."""
        with self._lock:
            if name in self._kept:
                return self._kept[name]
            engine = open_engine(self._bundle, name, self.device, self._threads, keep=False)
            size = self.size(name)
            if self._bytes + size <= self.memory:
                self._kept[name] = engine
                self._bytes += size
            return engine

    def size(self, name: str) -> int:
        """Return the bytes of the graph and its weights on disk."""
        path = self._bundle.path(name)
        return sum(file.stat().st_size for file in (path, path.with_suffix(".data")) if file.is_file())


def _free_memory() -> float:
    """Return the bytes available without swapping, or infinity if the system does not report them."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return float(line.split()[1]) * 1024
    except OSError:
        pass
    return float("inf")
