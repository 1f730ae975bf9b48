"""BC6H blocks taken apart and put together: mode, partition, endpoint codes and indices against the 16 bytes.

*Codes* are the quantised endpoints as the mode holds them after its differences are resolved: ``Mode.precision`` bits
each, unsigned, or two's complement for signed blocks. Shape [n, 4, 3]: endpoints 0 and 1 of region 0, 2 and 3 of
region 1 (zero for modes with one region), red, green, blue. *Endpoints* are the codes widened to the 16-bit integers
between which the format interpolates: 0 … 65535, or −32767 … 32767 for signed blocks; 31/64 (signed 31/32) of such a
number is the bit pattern of a half. Layouts come from ``bc6h_tables``, so every bit of a block that means something
survives ``bc6h_pack(bc6h_unpack(...))``; blocks of a reserved mode have none.
"""

import dataclasses
import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays
from warp_neumat.kernels.bc6h_tables import ANCHOR, INDEX_BIT, MODES, PARTITION_BIT
from warp_neumat.kernels.dispatch import launch, module_options

wp.set_module_options(module_options())

_GRAIN = 2048
"""Blocks worth a chunk of their own: one takes about 0.2 µs."""

_PARTITION = 12
"""Place of the partition number among the 12 codes' places, in the field table."""

# Columns of the mode table that both kernels read; row 0 is the reserved mode.
_BITS, _MODE_BITS, _REGIONS, _TRANSFORMED, _PRECISION, _DELTA, _FIRST_INDEX = 0, 1, 2, 3, 4, 5, 8
_COLUMNS = 9


def _mode_table() -> np.ndarray:
    rows = [(0,) * _COLUMNS]
    rows += [
        (m.bits, m.mode_bits, m.regions, m.transformed, m.precision, *m.delta, INDEX_BIT[m.regions]) for m in MODES
    ]
    return np.array(rows, np.int32)


def _field_table() -> np.ndarray:
    """For each mode and block bit: 32 × (place among the codes) + bit of it; −1 for mode bits and indices."""
    table = np.full((len(MODES) + 1, max(INDEX_BIT.values())), -1, np.int32)
    for m in MODES:
        for at, (channel, endpoint, bit) in enumerate(m.fields, m.mode_bits):
            table[m.number, at] = 32 * (3 * endpoint + channel) + bit
        if m.regions == 2:
            table[m.number, PARTITION_BIT : PARTITION_BIT + 5] = 32 * _PARTITION + np.arange(5)
    return table


def _number_table() -> np.ndarray:
    """Mode number for the low five bits of a block; 0 where reserved."""
    table = np.zeros(32, np.int32)
    for m in MODES:
        table[m.bits :: 1 << m.mode_bits] = m.number
    return table


@functools.cache
def _tables(device: str) -> tuple[wp.array, ...]:
    parts = (_mode_table().ravel(), _field_table().ravel(), _number_table(), ANCHOR.astype(np.int32))
    return tuple(wp.array(part, dtype=wp.int32, device=device) for part in parts)


_FIELDS = wp.constant(max(INDEX_BIT.values()))


@wp.func
def sign_extend(value: int, bits: int) -> int:
    """Read the low ``bits`` bits of ``value`` as a two's complement number."""
    return (value << (32 - bits)) >> (32 - bits)


@wp.func
def unquantise(code: int, precision: int, is_signed: int) -> int:
    """Widen a code of ``precision`` bits to the 16-bit integer that the format interpolates."""
    magnitude = wp.abs(code)
    bits, shift = precision, 16
    if is_signed != 0:
        bits, shift = precision - 1, 15
    top = (1 << bits) - 1
    wide = ((magnitude << shift) + (1 << (shift - 1))) >> bits
    if magnitude >= top:
        wide = (1 << shift) - 1
    if magnitude == 0 or bits >= 15:
        wide = magnitude
    return wp.where(code < 0, -wide, wide)


@wp.kernel
def bc6h_unpack_kernel(
    first: int,
    words: wp.array(dtype=wp.uint32),
    is_signed: int,
    modes: wp.array(dtype=wp.int32),
    fields: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.int32),
    anchors: wp.array(dtype=wp.int32),
    # outputs
    mode: wp.array(dtype=wp.uint8),
    partition: wp.array(dtype=wp.uint8),
    codes: wp.array(dtype=wp.int32),
    endpoints: wp.array(dtype=wp.int32),
    indices: wp.array(dtype=wp.uint8),
):
    b = first + wp.tid()
    number = numbers[int(words[4 * b] & wp.uint32(31))]
    row = number * _COLUMNS
    mode[b] = wp.uint8(number)
    for k in range(12):
        codes[12 * b + k] = 0
    shape = int(0)
    for at in range(modes[row + _MODE_BITS], modes[row + _FIRST_INDEX]):
        field = fields[number * _FIELDS + at]
        bit = int((words[4 * b + (at >> 5)] >> wp.uint32(at & 31)) & wp.uint32(1))
        if (field >> 5) == _PARTITION:
            shape = shape | (bit << (field & 31))
        else:
            codes[12 * b + (field >> 5)] = codes[12 * b + (field >> 5)] | (bit << (field & 31))
    partition[b] = wp.uint8(shape)
    precision = modes[row + _PRECISION]
    for c in range(3):
        base = codes[12 * b + c]
        delta = modes[row + _DELTA + c]
        for e in range(4):
            code = codes[12 * b + 3 * e + c]
            if e >= 2 * modes[row + _REGIONS]:
                code = int(0)
            else:
                if e > 0 and modes[row + _TRANSFORMED] != 0:
                    code = (base + sign_extend(code, delta)) & ((1 << precision) - 1)
                if is_signed != 0:
                    code = sign_extend(code, precision)
            codes[12 * b + 3 * e + c] = code
            endpoints[12 * b + 3 * e + c] = unquantise(code, precision, is_signed)
    at = modes[row + _FIRST_INDEX]
    anchor = wp.where(modes[row + _REGIONS] == 2, anchors[shape], 0)
    for t in range(16):
        width = wp.where(modes[row + _REGIONS] == 2, 3, 4)
        if t == 0 or t == anchor:
            width = width - 1
        if number == 0:
            width = 0
        value = int(0)
        for k in range(width):
            bit = int((words[4 * b + (at >> 5)] >> wp.uint32(at & 31)) & wp.uint32(1))
            value = value | (bit << k)
            at = at + 1
        indices[16 * b + t] = wp.uint8(value)


@wp.kernel
def bc6h_pack_kernel(
    first: int,
    mode: wp.array(dtype=wp.uint8),
    partition: wp.array(dtype=wp.uint8),
    codes: wp.array(dtype=wp.int32),
    indices: wp.array(dtype=wp.uint8),
    is_signed: int,
    modes: wp.array(dtype=wp.int32),
    fields: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.int32),
    anchors: wp.array(dtype=wp.int32),
    # outputs
    words: wp.array(dtype=wp.uint32),
    fault: wp.array(dtype=wp.uint8),
):
    b = first + wp.tid()
    number = int(mode[b])
    shape = int(partition[b])
    problem = int(0)
    if number < 1 or number > 14:
        problem = int(1)
        number = int(1)
    if shape > 31:
        problem = int(2)
        shape = int(0)
    row = number * _COLUMNS
    for k in range(4):
        words[4 * b + k] = wp.uint32(0)
    words[4 * b] = wp.uint32(modes[row + _BITS])
    precision = modes[row + _PRECISION]
    low = wp.where(is_signed != 0, -(1 << (precision - 1)), 0)
    for e in range(2 * modes[row + _REGIONS]):
        for c in range(3):
            code = codes[12 * b + 3 * e + c]
            if code < low or code >= low + (1 << precision):
                problem = int(3)
            if e > 0 and modes[row + _TRANSFORMED] != 0:
                delta = modes[row + _DELTA + c]
                step = sign_extend(code - codes[12 * b + c], precision)
                if sign_extend(step, delta) != step:
                    problem = int(4)
    for at in range(modes[row + _MODE_BITS], modes[row + _FIRST_INDEX]):
        field = fields[number * _FIELDS + at]
        value = shape
        if (field >> 5) != _PARTITION:
            value = codes[12 * b + (field >> 5)]
            if (field >> 5) > 2 and modes[row + _TRANSFORMED] != 0:
                value = value - codes[12 * b + (field >> 5) % 3]
        bit = wp.uint32((value >> (field & 31)) & 1)
        words[4 * b + (at >> 5)] = words[4 * b + (at >> 5)] | (bit << wp.uint32(at & 31))
    at = modes[row + _FIRST_INDEX]
    anchor = wp.where(modes[row + _REGIONS] == 2, anchors[shape], 0)
    for t in range(16):
        width = wp.where(modes[row + _REGIONS] == 2, 3, 4)
        if t == 0 or t == anchor:
            width = width - 1
        value = int(indices[16 * b + t])
        if (value >> width) != 0:
            problem = int(5)
        for k in range(width):
            bit = wp.uint32((value >> k) & 1)
            words[4 * b + (at >> 5)] = words[4 * b + (at >> 5)] | (bit << wp.uint32(at & 31))
            at = at + 1
    fault[b] = wp.uint8(problem)


_FAULTS = {
    1: "mode must be 1 to 14",
    2: "partition must be 0 to 31",
    3: "codes must fit the precision of their mode; clamp them with bc6h_quantise",
    4: "codes must fit the differences of their mode; bc6h_clamp brings them near endpoint 0",
    5: "indices must fit 3 bits (one region: 4), an anchor's one bit less; swap the two endpoints of its region",
}


@dataclasses.dataclass(frozen=True)
class Unpacked:
    """What BC6H blocks say: arrays of one kind (numpy, torch or Warp)."""

    mode: object
    """Mode number 1 … 14, 0 where reserved; shape [n], uint8."""
    partition: object
    """Partition number 0 … 31, 0 for one region; shape [n], uint8."""
    codes: object
    """Quantised endpoints with differences resolved; shape [n, 4, 3], int32."""
    endpoints: object
    """The codes widened to 16-bit integers; shape [n, 4, 3], int32."""
    indices: object
    """Index of each texel t = 4y + x; shape [n, 16], uint8."""


def bc6h_unpack(blocks, signed: bool = False) -> Unpacked:
    """Take BC6H blocks apart, spread over all cores.

    Args:
        blocks: BC6H blocks, shape [n, 16], uint8; numpy, torch or Warp.
        signed: Whether they are of the signed format.

    Raises: ValueError: If the shape differs.
    """
    kind = arrays.kind_of(blocks)
    data = arrays.take(blocks, "blocks", ("n", 16), wp.uint8, kind)
    count = data.shape[0]
    types = {
        "mode": ((count,), wp.uint8),
        "partition": ((count,), wp.uint8),
        "codes": ((count, 4, 3), wp.int32),
        "endpoints": ((count, 4, 3), wp.int32),
        "indices": ((count, 16), wp.uint8),
    }
    out = {name: kind.empty(shape, dtype) for name, (shape, dtype) in types.items()}
    if count:
        launch(
            bc6h_unpack_kernel,
            count,
            inputs=[as_scalars(data, wp.uint32), int(bool(signed)), *_tables(str(kind.device))],
            outputs=[array.flatten() for array in out.values()],
            device=kind.device,
            grain=_GRAIN,
        )
    return Unpacked(**{name: kind.give(array) for name, array in out.items()})


def bc6h_pack(mode, partition, codes, indices, signed: bool = False):
    """Put BC6H blocks together, spread over all cores.

    Args:
        mode: Mode number 1 … 14, shape [n], uint8; numpy, torch or Warp, as the others.
        partition: Partition number 0 … 31, shape [n], uint8; ignored for modes with one region.
        codes: Quantised endpoints with differences resolved, shape [n, 4, 3], int32.
        indices: Index of each texel, shape [n, 16], uint8; anchor texels in the lower half.
        signed: Whether the blocks are of the signed format.

    Returns: Blocks, shape [n, 16], uint8, of the kind of ``codes``.
    Raises: ValueError: If a shape differs, or a block cannot be expressed: the message names the first and the rule.
    """
    kind = arrays.kind_of(codes)
    values = arrays.take(codes, "codes", ("n", 4, 3), wp.int32, kind)
    count = values.shape[0]
    inputs = [
        arrays.take(mode, "mode", (count,), wp.uint8, kind),
        arrays.take(partition, "partition", (count,), wp.uint8, kind),
        values,
        arrays.take(indices, "indices", (count, 16), wp.uint8, kind),
    ]
    return kind.give(pack_blocks(inputs, count, signed, kind.device, check=True))


def as_scalars(array: wp.array, dtype) -> wp.array:
    """View the memory of a contiguous array as a flat one of another scalar type."""
    size = array.size * wp.types.type_size_in_bytes(array.dtype) // wp.types.type_size_in_bytes(dtype)
    view = wp.array(ptr=array.ptr, shape=(size,), dtype=dtype, device=array.device)
    view._ref = array  # the view borrows the memory
    return view


def pack_blocks(inputs, count: int, signed: bool, device, *, check: bool) -> wp.array:
    """Return the blocks [n, 16] of Warp arrays ``(mode, partition, codes, indices)``; ``check`` raises on faults."""
    blocks = wp.empty((count, 16), dtype=wp.uint8, device=device)
    if count == 0:
        return blocks
    fault = wp.empty(count, dtype=wp.uint8, device=device)
    launch(
        bc6h_pack_kernel,
        count,
        inputs=[*(array.flatten() for array in inputs), int(bool(signed)), *_tables(str(device))],
        outputs=[as_scalars(blocks, wp.uint32), fault],
        device=device,
        grain=_GRAIN,
    )
    if check and (found := np.flatnonzero(faults := fault.numpy())).size:
        raise ValueError(f"block {found[0]}: {_FAULTS[int(faults[found[0]])]}")
    return blocks


def _columns(mode) -> tuple[np.ndarray, ...]:
    """Return precision [n, 1, 1], transformed [n, 1, 1] and difference bits [n, 1, 3] of mode numbers."""
    rows = _mode_table()[np.asarray(mode, np.int64)]
    if (np.asarray(mode) < 1).any():
        raise ValueError("mode must be 1 to 14, got 0, which stands for the reserved ones")
    return (
        rows[:, _PRECISION, None, None],
        rows[:, _TRANSFORMED, None, None] != 0,
        rows[:, None, _DELTA : _DELTA + 3],
    )


def bc6h_unquantise(codes, mode, signed: bool = False) -> np.ndarray:
    """Return the 16-bit integers of codes: NumPy, shape [n, 4, 3], int32.

    Args:
        codes: Shape [n, 4, 3].
        mode: Mode number of each block, shape [n].
        signed: Whether the blocks are of the signed format.
    """
    precision, _, _ = _columns(mode)
    codes = np.asarray(codes, np.int64)
    magnitude, bits, shift = np.abs(codes), precision - bool(signed), 16 - bool(signed)
    wide = ((magnitude << shift) + (1 << (shift - 1))) >> bits
    wide = np.where(magnitude >= (1 << bits) - 1, (1 << shift) - 1, wide)
    wide = np.where((magnitude == 0) | (bits >= 15), magnitude, wide)
    return (np.sign(codes) * wide).astype(np.int32)


def bc6h_quantise(endpoints, mode, signed: bool = False) -> np.ndarray:
    """Return the codes whose 16-bit integers are nearest ``endpoints``: NumPy, shape [n, 4, 3], int32.

    Differences are not limited: see :func:`bc6h_clamp`.

    Args:
        endpoints: Endpoints in the 16-bit integer domain, any real type, shape [n, 4, 3]; out of range is clamped.
        mode: Mode number of each block, shape [n].
        signed: Whether the blocks are of the signed format.
    """
    precision, _, _ = _columns(mode)
    value = np.asarray(endpoints, np.float64)
    value = np.where(np.isnan(value), 0.0, value)
    bits, full = precision - bool(signed), 32768.0 if signed else 65536.0
    top = (1 << bits) - 1
    steps = np.abs(value if signed else np.maximum(value, 0.0)) * (2.0**bits / full)
    code = np.minimum(np.floor(steps), top)
    # The lowest and the highest code stand for the ends of the range, not for the middle of their step.
    code = np.where((code == 0) & (steps > 0.75), 1, code)
    code = np.where((code == top) & (steps < top + 0.25), top - 1, code)
    code = np.where(bits >= 15, np.minimum(np.floor(steps + 0.5), top), code)
    return (np.sign(value) * code).astype(np.int32)


def bc6h_clamp(codes, mode) -> np.ndarray:
    """Return codes brought within the difference range of their mode around endpoint 0: NumPy, shape [n, 4, 3].

    Modes without differences keep theirs. ``(bc6h_clamp(codes, mode) == codes).all((1, 2))`` tells which blocks a mode
    can hold.

    Args:
        codes: Shape [n, 4, 3].
        mode: Mode number of each block, shape [n].
    """
    _, transformed, delta = _columns(mode)
    codes = np.asarray(codes, np.int32)
    reach = (1 << (delta - 1)).astype(np.int32)
    near = np.clip(codes, codes[:, :1] - reach, codes[:, :1] + reach - 1)
    near[:, 0] = codes[:, 0]
    return np.where(transformed, near, codes)
