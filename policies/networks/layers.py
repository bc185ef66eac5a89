"""Layers of networks in NumPy, with the definitions of torch.

`einsum` uses NumPy's own loops instead of a threaded BLAS, so that results are bit-identical for any number of threads,
as replay requires.
"""

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]


def linear(inputs: Array, weight: NDArray[Any], bias: NDArray[Any]) -> Array:
    """Linear layer: inputs (n, i), weight (o, i), bias (o,) → (n, o)."""
    return np.asarray(np.einsum("ni,oi->no", inputs, weight) + bias)


def convolution(images: Array, weight: NDArray[Any], bias: NDArray[Any]) -> Array:
    """Convolution without padding: images (n, c, h, w), weight (o, c, p, q), bias (o,).

    Returns images (n, o, h − p + 1, w − q + 1).
    """
    windows = sliding_window_view(images, weight.shape[2:], axis=(2, 3))
    n, _, rows, cols = windows.shape[:4]
    patches = windows.transpose(0, 2, 3, 1, 4, 5).reshape(n * rows * cols, -1)
    flat = linear(patches, weight.reshape(len(weight), -1), bias)
    return np.asarray(flat.reshape(n, rows, cols, -1).transpose(0, 3, 1, 2))


def max_pool(images: Array) -> Array:
    """Largest value of each 2 × 2 block: (n, c, h, w) → (n, c, h // 2, w // 2)."""
    n, c, h, w = images.shape
    blocks = images[:, :, : h // 2 * 2, : w // 2 * 2].reshape(n, c, h // 2, 2, w // 2, 2)
    return np.asarray(blocks.max(axis=(3, 5)))


def relu(values: Array) -> Array:
    """max(values, 0)."""
    return np.maximum(values, 0)


def gru_cell(inputs: Array, memory: Array, tensors: dict[str, Array]) -> Array:
    """Next memory (n, h) of a gated recurrent unit for inputs (n, i); tensors as in `torch.nn.GRUCell`."""
    from_inputs = np.split(linear(inputs, tensors["weight_ih"], tensors["bias_ih"]), 3, axis=1)
    from_memory = np.split(linear(memory, tensors["weight_hh"], tensors["bias_hh"]), 3, axis=1)
    reset = _sigmoid(from_inputs[0] + from_memory[0])
    update = _sigmoid(from_inputs[1] + from_memory[1])
    new = np.tanh(from_inputs[2] + reset * from_memory[2])
    return np.asarray((1 - update) * new + update * memory)


def _sigmoid(values: Array) -> Array:
    return np.asarray(0.5 * (1 + np.tanh(0.5 * values)))
