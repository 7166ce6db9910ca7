"""Flow time: the sigmas at which a sampler stops, from 1 (noise) down to 0 (image)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

MOST_SHIFT = 1e4  # above it, float32 cannot tell a thousand sigmas next to 1 apart


@dataclass(frozen=True)
class ShiftSchedule:
    """sigma = s u / (1 + (s - 1) u) for u in even steps from 1 to 0 (Stable Diffusion 3, arXiv 2403.03206,
    eq. 23).

    shift: 0 < s <= MOST_SHIFT. Above 1, more of the steps are near noise; 1 makes even steps.
    """

    shift: float
    kind: Literal["shift"] = "shift"

    def __post_init__(self) -> None:
        if not 0 < self.shift <= MOST_SHIFT:
            raise ValueError(f"shift must be a positive number up to {MOST_SHIFT:g}, not {self.shift}")

    def sigmas(self, steps: int) -> NDArray[np.float32]:
        """Return steps + 1 falling values, the first 1 and the last 0."""
        return np.append(shift_sigma(_even(steps), self.shift), 0.0).astype(np.float32)


@dataclass(frozen=True)
class DynamicShiftSchedule:
    """The shift grows with the picture: sigma = e^mu / (e^mu + 1/u - 1), stretched to end at `terminal`.

    mu lies on the straight line through (base_tokens, base_shift) and (max_tokens, max_shift); after the
    stretch the last sigma before 0 is `terminal`. This is diffusers' FlowMatchEulerDiscreteScheduler with
    use_dynamic_shifting, time_shift_type "exponential" and shift_terminal.
    """

    base_shift: float
    max_shift: float
    base_tokens: int
    max_tokens: int
    terminal: float
    kind: Literal["dynamic_shift"] = "dynamic_shift"

    def __post_init__(self) -> None:
        if not 0 < self.base_tokens < self.max_tokens:
            raise ValueError("base_tokens must lie between 0 and max_tokens")
        if not 0 < self.terminal < 1:
            raise ValueError("terminal must lie between 0 and 1")

    def sigmas(self, steps: int, tokens: int) -> NDArray[np.float32]:
        """Return steps + 1 falling values, from 1 to 0, for a picture of `tokens` latent patches."""
        slope = (self.max_shift - self.base_shift) / (self.max_tokens - self.base_tokens)
        shift = math.exp(self.base_shift + slope * (tokens - self.base_tokens))
        u = _even(steps)
        sigma = shift / (shift + 1 / u - 1)
        if steps > 1:  # the last sigma of a single step is its first, which is pure noise
            sigma = 1 - (1 - sigma) * (1 - self.terminal) / (1 - sigma[-1])
        return np.append(sigma, 0.0).astype(np.float32)


def shift_sigma(u: Any, shift: float) -> Any:
    """Return s u / (1 + (s - 1) u): even flow time u, moved towards noise by a shift s > 1.

    u: a NumPy array, a torch tensor or a float; training draws its sigmas with the same function.
    """
    return shift * u / (1 + (shift - 1) * u)


Schedule = ShiftSchedule | DynamicShiftSchedule


def _even(steps: int) -> NDArray[np.float64]:
    if steps < 1:
        raise ValueError(f"a schedule needs at least 1 step, not {steps}")
    return np.linspace(1.0, 1.0 / steps, steps)
