"""Flow time: the sigmas at which a sampler stops, from 1 (noise) down to 0 (image)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

MOST_SHIFT = 1e4  # of more, float32 would round neighbours of a thousand sigmas next to 1 to the same number


@dataclass(frozen=True)
class ShiftSchedule:
    """sigma = s u / (1 + (s - 1) u) over u even from 1 to 0 (Stable Diffusion 3, arXiv 2403.03206, eq. 23).

    shift s, 0 < s <= MOST_SHIFT: above 1 more of the steps are spent near noise; 1 makes even steps.
    """

    shift: float
    kind: Literal["shift"] = "shift"

    def __post_init__(self) -> None:
        if not 0 < self.shift <= MOST_SHIFT:
            raise ValueError(f"shift must be a positive number up to {MOST_SHIFT:g}, not {self.shift}")

    def sigmas(self, steps: int) -> NDArray[np.float32]:
        """steps + 1 falling values, the first 1 and the last 0."""
        u = _even(steps)
        return np.append(self.shift * u / (1 + (self.shift - 1) * u), 0.0).astype(np.float32)


@dataclass(frozen=True)
class DynamicShiftSchedule:
    """The shift grows with the picture: sigma = e^mu / (e^mu + 1/u - 1), stretched to end at `terminal`.

    mu runs on the straight line through (base_tokens, base_shift) and (max_tokens, max_shift); after the
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
        """steps + 1 falling values, the first 1 and the last 0, for a picture of `tokens` latent patches."""
        slope = (self.max_shift - self.base_shift) / (self.max_tokens - self.base_tokens)
        shift = math.exp(self.base_shift + slope * (tokens - self.base_tokens))
        u = _even(steps)
        sigma = shift / (shift + 1 / u - 1)
        if steps > 1:  # a single step has no last sigma but its first, and that is pure noise
            sigma = 1 - (1 - sigma) * (1 - self.terminal) / (1 - sigma[-1])
        return np.append(sigma, 0.0).astype(np.float32)


Schedule = ShiftSchedule | DynamicShiftSchedule


def _even(steps: int) -> NDArray[np.float64]:
    if steps < 1:
        raise ValueError(f"a schedule needs at least 1 step, not {steps}")
    return np.linspace(1.0, 1.0 / steps, steps)
