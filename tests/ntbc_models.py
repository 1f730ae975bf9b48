"""Random NTBC models in NumPy, for what runs their networks."""

import numpy as np

from warp_neumat.kernels.ntbc import ModelShape
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.reference import ntbc as reference


def random_network(shape: NetworkShape, rng) -> tuple[np.ndarray, np.ndarray]:
    """(grids, net) of a network whose outputs vary, with zeros where it is padded."""
    net = np.zeros(shape.weights, np.float32)
    widths = (shape.inputs, *shape.hidden, shape.outputs)
    for n, (bias, at) in enumerate(shape.offsets):
        wide, tall = shape.rows[n + 1], shape.rows[n]
        net[bias : bias + widths[n + 1]] = 0.1 * rng.standard_normal(widths[n + 1])
        matrix = net[at : at + tall * wide].reshape(tall, wide)
        matrix[: widths[n], : widths[n + 1]] = rng.standard_normal((widths[n], widths[n + 1])) * widths[n] ** -0.5
    return rng.standard_normal(shape.grid_words).astype(np.float32), net


def random_model(shape: ModelShape, rng) -> tuple[np.ndarray, ...]:
    """(endpoint grid, endpoint net, texel grid, texel net)."""
    return (*random_network(shape.endpoint, rng), *random_network(shape.texel, rng))


def predict(shape: ModelShape, arrays, rows: int, columns: int):
    """Endpoints (blocks, 2C) and colours (blocks, C, 16) of a model in float64."""
    ends = reference.network(*reference.unpack(shape.endpoint, *arrays[:2]), reference.positions(rows, columns, False))
    x = reference.network(*reference.unpack(shape.texel, *arrays[2:]), reference.positions(rows, columns, True))
    x = x.reshape(rows * columns, 16, -1).swapaxes(1, 2)
    if not shape.naive:
        return ends, x
    shown, at = [], 0
    for plane, (_, k) in enumerate(shape.planes):
        e0, e1 = np.split(ends[:, 2 * at : 2 * at + 2 * k], 2, axis=1)
        shown.append(reference.decode(x[:, plane], e0, e1).swapaxes(1, 2))
        at += k
    return ends, np.concatenate(shown, 1)
