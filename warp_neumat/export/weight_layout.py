"""Where a network's fp16 numbers lie in `NAME_weights.bin`.

The file is an array of 16-byte rows, little endian, that a shader binds as ``uvec4`` (or reads as 8 halves): first
``weight0`` (one matrix row per hidden unit, inputs in the order T0.rgb, T1.rgb, …), then ``bias0``, ``weight1`` (one
matrix row per channel) and ``bias1``. Every matrix row and every bias vector starts on a new 16-byte row and is filled
up with zeros, so that whole rows enter a dot product. The files of several materials laid end to end are one buffer:
the base of a material is the number of 16-byte rows before it.
"""

import dataclasses

import numpy as np

ROW_HALVES = 8
"""Halves in a row of 16 bytes."""


@dataclasses.dataclass(frozen=True)
class Block:
    """One tensor in the file.

    Attributes:
        name: ``weight0``, ``bias0``, ``weight1`` or ``bias1``.
        shape: Shape of the tensor, without the padding.
        row: First 16-byte row.
        stride: 16-byte rows per matrix row; of a bias, of the whole vector.
    """

    name: str
    shape: tuple[int, ...]
    row: int
    stride: int

    @property
    def rows(self) -> int:
        """16-byte rows in total."""
        return self.stride * (self.shape[0] if len(self.shape) == 2 else 1)


def layout(inputs: int, hidden: int, outputs: int) -> dict[str, Block]:
    """Return where each tensor of an ``inputs`` → ``hidden`` → ``outputs`` network lies, by name, in file order."""
    shapes = {"weight0": (hidden, inputs), "bias0": (hidden,), "weight1": (outputs, hidden), "bias1": (outputs,)}
    blocks, row = {}, 0
    for name, shape in shapes.items():
        blocks[name] = Block(name, shape, row, -(-shape[-1] // ROW_HALVES))
        row += blocks[name].rows
    return blocks


def pack_weights(tensors: dict[str, np.ndarray]) -> np.ndarray:
    """Return the file's contents, shape [rows, 8], little-endian float16.

    Args:
        tensors: ``weight0`` [H, 3T], ``bias0`` [H], ``weight1`` [C, H] and ``bias1`` [C], float16; others are ignored.
    """
    (hidden, inputs), outputs = tensors["weight0"].shape, len(tensors["bias1"])
    blocks = layout(inputs, hidden, outputs)
    rows = np.zeros((sum(block.rows for block in blocks.values()), ROW_HALVES), "<f2")
    for name, block in blocks.items():
        lines = rows[block.row : block.row + block.rows].reshape(-1, block.stride * ROW_HALVES)
        lines[:, : block.shape[-1]] = tensors[name]
    return rows


def unpack_weights(rows: np.ndarray, inputs: int, hidden: int, outputs: int) -> dict[str, np.ndarray]:
    """Return the tensors that :func:`pack_weights` laid out, float16."""
    rows, tensors = np.asarray(rows, np.float16).reshape(-1, ROW_HALVES), {}
    for name, block in layout(inputs, hidden, outputs).items():
        lines = rows[block.row : block.row + block.rows].reshape(-1, block.stride * ROW_HALVES)
        tensors[name] = lines[:, : block.shape[-1]].reshape(block.shape).copy()
    return tensors
