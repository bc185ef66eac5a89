"""Noise on the flow maps of the insertion: errors of cameras and gels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FlowMapNoise:
    """Noise of real pads and cameras that the simulator does not model, sampled per part unless stated otherwise.

    Lengths are relative to 1, the longest vector of a flow map with contact.
    """

    marker: float = 0.05  # largest standard deviation of marker vectors, sampled per attempt
    offset: float = 0.03  # standard deviation of the common shift of a pad, sampled per attempt (reference drift)
    gain: float = 0.05  # standard deviation of the logarithmic gain of a pad (gel stiffness)
    turn: float = 0.03  # standard deviation of the rotation of a camera relative to its pad [rad]

    def sample(self, count: int, sensors: int, rng: np.random.Generator) -> Array:
        """Noise of `count` parts: marker level, gain and rotation of each sensor; shape (count, 1 + 2 sensors)."""
        level = rng.uniform(0, self.marker, (count, 1))
        gain = np.exp(rng.normal(0, self.gain, (count, sensors)))
        turn = rng.normal(0, self.turn, (count, sensors))
        return np.concatenate([level, gain, turn], axis=1)

    def apply(self, images: NDArray[Any], part_noise: Array, rng: np.random.Generator) -> NDArray[np.float32]:
        """Adds noise to flow maps (n, frames * sensors * 2, rows, cols); preserves the length of the longest vector."""
        n, channels, rows, cols = images.shape
        sensors = (part_noise.shape[1] - 1) // 2
        flow = images.reshape(n, channels // (2 * sensors), sensors, 2, rows, cols).astype(np.float32)
        max_length = _max_length(flow)
        level, gain, turn = np.split(part_noise.astype(np.float32), [1, 1 + sensors], axis=1)
        scale = gain[:, None, :, None, None]
        cos, sin = np.cos(turn)[:, None, :, None, None], np.sin(turn)[:, None, :, None, None]
        x, y = flow[:, :, :, 0], flow[:, :, :, 1]
        noisy = np.stack([scale * (cos * x - sin * y), scale * (sin * x + cos * y)], axis=3)
        noisy += level[:, :, None, None, None, None] * rng.standard_normal(noisy.shape, dtype=np.float32)
        drift = rng.standard_normal((n, 1, sensors, 2, 1, 1), dtype=np.float32)
        noisy += np.float32(self.offset) * drift
        noisy *= (max_length / np.maximum(_max_length(noisy), 1e-6))[:, None, None, None, None, None]
        return np.asarray(noisy.reshape(images.shape))


def _max_length(flow: NDArray[Any]) -> NDArray[np.float32]:
    return np.asarray(np.sqrt((flow * flow).sum(3).max(axis=(1, 2, 3, 4))))
