"""Inference of NTBC: both networks over all blocks, straight to the bytes of BC1, BC4 and BC7 blocks (NTBC §3.2).

Per block the endpoint network is run once and the texel network 16 times; of every plane, the predicted endpoints and
colours then go through the writer of its format (``block_pack``), which rounds the endpoints and gives each texel the
nearest entry of the palette that a decoder will see (NTBC Eq. 9, 10). In the naive variant the texel network says
weights, and the colours are what they make of the endpoints.

On the CPU a thread owns :data:`PATCH` blocks, whose rows go through the vector code of ``ntbc_network``; on CUDA one
thread owns one block and runs plain C++.
"""

import dataclasses
import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch
from warp_neumat.kernels.block_pack import pack_code
from warp_neumat.kernels.ntbc_network import (
    HEAD,
    SELU_ALPHA,
    SELU_SCALE,
    TAP,
    Layout,
    NetworkCode,
    NetworkShape,
    check_outputs,
)

PATCH = 16
"""Blocks that one CPU thread owns."""

MOST_NUMBERS = 1 << 31
"""Texels of whole blocks times components that a model must stay below, to number its colours in 31 bits."""

FORMATS = {"bc1": (8, 4, (3,)), "bc4": (8, 8, (1,)), "bc7": (16, 16, (3, 4))}
"""Bytes of a block, entries of its palette, and how many channels it can hold."""


@dataclasses.dataclass(frozen=True)
class ModelShape:
    """Sizes of a model: two networks and the planes that they serve, as (format, channels)."""

    endpoint: NetworkShape
    texel: NetworkShape
    planes: tuple[tuple[str, int], ...]
    naive: bool = False

    def __post_init__(self):
        for name, channels in self.planes:
            if name not in FORMATS or channels not in FORMATS[name][2]:
                raise ValueError(f"planes must be ('bc1', 3), ('bc4', 1) or ('bc7', 3 or 4), got {(name, channels)}")
        check_outputs(self.endpoint, self.texel, len(self.planes), self.channels, self.naive, self.planes)

    @property
    def channels(self) -> int:
        """Channels of all planes."""
        return sum(channels for _, channels in self.planes)

    @property
    def palettes(self) -> tuple[tuple[int, int], ...]:
        """(entries, channels) of every plane, as training names them."""
        return tuple((FORMATS[name][1], channels) for name, channels in self.planes)

    @property
    def flops(self) -> int:
        """Operations of all matrix products of one block."""
        return self.endpoint.flops + 16 * self.texel.flops


def _write(planes, naive: bool) -> str:
    """C++ that writes ``block`` from ``ends`` [2C] and ``texels`` [outputs][16]; colours go to ``shown`` [C][16]."""
    text, channel, before = [], 0, 0
    for plane, (name, k) in enumerate(planes):
        text.append(f"{{ const float* const e0 = ends + {2 * channel}; const float* const e1 = e0 + {k};")
        if naive:
            text.append(
                f"for (int c = 0; c < {k}; ++c) for (int t = 0; t < 16; ++t) shown[16 * ({channel} + c) + t] ="
                f" (1.0f - texels[{16 * plane} + t]) * e0[c] + texels[{16 * plane} + t] * e1[c];"
            )
        text.append(f"const float* const colours = shown + {16 * channel};")
        text.append(f"const float* const G = metric.data + {16 * plane};")
        size = FORMATS[name][0]
        text.append(f"unsigned char* const out = written.data + {before} * (long long)count + {size} * block;")
        call = {
            "bc1": "Pack::write_bc1(e0, e1, colours, G, out);",
            "bc4": "(void)G; Pack::write_bc4(e0[0], e1[0], colours, out);",
            "bc7": f"Pack::write_bc7(e0, e1, colours, {k}, G, out);",
        }
        text.append(f"{call[name]} }}")
        channel, before = channel + k, before + size
    text.append(
        f"if (keep) for (int i = 0; i < {16 * channel}; ++i) predicted.data[block * {16 * channel} + i] = shown[i];"
    )
    return "\n".join(text)


_NAMES = """
const float* const E_net = endpoint_net.data; const float* const X_net = texel_net.data;
const float* const E_grid = endpoint_grid.data; const float* const X_grid = texel_grid.data;
const int* const E_table = endpoint_table.data; const int* const X_table = texel_table.data;
"""


def _codes(endpoint: Layout, texel: Layout) -> tuple[NetworkCode, NetworkCode]:
    return NetworkCode(endpoint, "E", PATCH), NetworkCode(texel, "X", 16 * PATCH)


def _scratch(endpoint: Layout, texel: Layout) -> int:
    return sum(code.scratch(False) for code in _codes(endpoint, texel)) + 64


def _cpu_code(endpoint: Layout, texel: Layout, planes, naive: bool) -> str:
    ends, texels = _codes(endpoint, texel)
    channels = sum(k for _, k in planes)
    shown = f"float shown[{16 * channels}];" if naive else "float* const shown = texels;"
    return f"""{pack_code()} {HEAD} {_NAMES}
    float* at = scratch.data + (long long)slot * {_scratch(endpoint, texel)};
    at += (16 - ((unsigned long long)at / 4) % 16) % 16;
    {ends.declare(False)} {texels.declare(False)}
    int numbers[{PATCH}];    // the last patch repeats the last block
    for (int b = 0; b < {PATCH}; ++b) numbers[b] = {PATCH} * patch + b < count ? {PATCH} * patch + b : count - 1;
    {ends.gather(ends.blocks)} {ends.forward(True)} {texels.gather(texels.texels)} {texels.forward(True)}
    for (int b = 0; b < {PATCH} && {PATCH} * patch + b < count; ++b) {{
        const long long block = numbers[b];
        const float* const ends = E_Y + b * {endpoint.rows[-1]};
        const float* const rows = X_Y + 16 * b * {texel.rows[-1]};
        float texels[{16 * texel.outputs}];
        for (int c = 0; c < {texel.outputs}; ++c)
            for (int t = 0; t < 16; ++t) texels[16 * c + t] = rows[t * {texel.rows[-1]} + c];
        {shown}
        {_write(planes, naive)}
    }}"""


def _scalar_network(layout: Layout, name: str, target: str, stride: int) -> str:
    """C++ of one row at (u, v), whose outputs go to target[c · stride]."""
    features, widest = layout.features, max(layout.rows)
    text = [f"float h0[{widest}], h1[{widest}];"]
    text.append(f"""for (int k = 0; k < {layout.levels}; ++k) {{ const int* const level = {name}_table + 3 * k;
        int i0, i1, j0, j1; float fx, fy;
        tap(u, level[0], i0, i1, fx); tap(v, level[1], j0, j1, fy);
        const float* const upper = {name}_grid + level[2] + (long long)j0 * level[0] * {features};
        const float* const lower = {name}_grid + level[2] + (long long)j1 * level[0] * {features};
        for (int f = 0; f < {features}; ++f) {{
            const float a = upper[i0 * {features} + f], b = lower[i0 * {features} + f];
            const float top = a + (upper[i1 * {features} + f] - a) * fx;
            const float bottom = b + (lower[i1 * {features} + f] - b) * fx;
            h0[k * {features} + f] = top + (bottom - top) * fy;
        }} }}""")
    widths, rows = layout.widths, layout.rows
    for n, (bias, weights) in enumerate(layout.offsets):
        last = n == len(layout.offsets) - 1
        value = "1.0f / (1.0f + expf(-s))" if last else (
            f"s > 0.0f ? s * {SELU_SCALE}f : (expf(s) - 1.0f) * {SELU_SCALE * SELU_ALPHA}f"
        )  # fmt: skip
        out = f"{target}[o * {stride}]" if last else f"h{(n + 1) % 2}[o]"
        text.append(
            f"for (int o = 0; o < {widths[n + 1]}; ++o) {{ float s = {name}_net[{bias} + o];"
            f" for (int k = 0; k < {widths[n]}; ++k)"
            f" s += h{n % 2}[k] * {name}_net[{weights} + k * {rows[n + 1]} + o]; {out} = {value}; }}"
        )
    return "\n".join(text)


def _scalar_code(endpoint: Layout, texel: Layout, planes, naive: bool) -> str:
    channels = sum(k for _, k in planes)
    shown = f"float shown[{16 * channels}];" if naive else "float* const shown = texels;"
    return f"""{pack_code()} {TAP} {_NAMES}
    const long long block = patch;
    const int by = patch / block_columns, bx = patch - by * block_columns;
    float ends[{2 * channels}], texels[{16 * texel.outputs}];
    {{ const double u = (bx + 0.5) / block_columns, v = (by + 0.5) / block_rows;
       {_scalar_network(endpoint, "E", "ends", 1)} }}
    for (int t = 0; t < 16; ++t) {{
        const double u = (4 * bx + t % 4 + 0.5) * (0.25 / block_columns);
        const double v = (4 * by + t / 4 + 0.5) * (0.25 / block_rows);
        {_scalar_network(texel, "X", "(texels + t)", 16)} }}
    {shown}
    {_write(planes, naive)}"""


@functools.cache
def _make_kernel(endpoint: Layout, texel: Layout, planes: tuple[tuple[str, int], ...], naive: bool, wide: bool):
    """Return the kernel of these networks, for the CPU if ``wide``."""

    @wp.func_native((_cpu_code if wide else _scalar_code)(endpoint, texel, planes, naive))
    def write_patch(
        patch: int,
        slot: int,
        count: int,
        block_rows: int,
        block_columns: int,
        keep: int,
        metric: wp.array(dtype=wp.float32),
        endpoint_table: wp.array(dtype=wp.int32),
        endpoint_grid: wp.array(dtype=wp.float32),
        endpoint_net: wp.array(dtype=wp.float32),
        texel_table: wp.array(dtype=wp.int32),
        texel_grid: wp.array(dtype=wp.float32),
        texel_net: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        written: wp.array(dtype=wp.uint8),
        predicted: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def ntbc_blocks_kernel(
        first: int,
        slot: int,
        count: int,
        block_rows: int,
        block_columns: int,
        keep: int,
        metric: wp.array(dtype=wp.float32),
        endpoint_table: wp.array(dtype=wp.int32),
        endpoint_grid: wp.array(dtype=wp.float32),
        endpoint_net: wp.array(dtype=wp.float32),
        texel_table: wp.array(dtype=wp.int32),
        texel_grid: wp.array(dtype=wp.float32),
        texel_net: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        written: wp.array(dtype=wp.uint8),
        predicted: wp.array(dtype=wp.float32),
    ):
        write_patch(
            first + wp.tid(), slot, count, block_rows, block_columns, keep, metric, endpoint_table, endpoint_grid,
            endpoint_net, texel_table, texel_grid, texel_net, scratch, written, predicted,
        )  # fmt: skip

    return ntbc_blocks_kernel


def make_blocks_kernel(shape: ModelShape, wide: bool):
    """Return the inference kernel of a model: for the CPU if ``wide``, else for CUDA. Sizes of levels are no part."""
    return _make_kernel(shape.endpoint.layout, shape.texel.layout, shape.planes, shape.naive, wide)


def ntbc_blocks(
    shape: ModelShape,
    rows: int,
    columns: int,
    endpoint_grid,
    endpoint_net,
    texel_grid,
    texel_net,
    *,
    metric=None,
    predicted: bool = False,
    device=None,
):
    """Run both networks over all blocks of a texture and return the blocks of each plane, spread over all cores.

    Args:
        shape: Sizes of the networks and the planes.
        rows, columns: Blocks of the texture; a mip level is written by asking for fewer.
        endpoint_grid, texel_grid: Flat float32 grids, (grid_words,); numpy, torch or Warp.
        endpoint_net, texel_net: Packed float32 weights, (weights,).
        metric: (planes, 4, 4) float32 that indices are chosen in; default: identity. BC4 has no need of it.
        predicted: Whether the colours that the networks predict are returned too.
        device: Where numpy arrays go; default: Warp's current device.

    Returns:
        A list with, per plane, bytes uint8 (rows, columns, 8 or 16), of the kind of ``endpoint_grid``; with
        ``predicted`` a pair of that list and the colours, float32 (rows · columns, C, 16).

    Raises: ValueError: If a shape or device differs.

    Error: predicted colours 1e-5, a 390th of a step of 8 bits; blocks decode as those packed in float64 but for
    less than 5 in 1000; held by test_blocks_match_float64.
    """
    if rows < 1 or columns < 1:
        raise ValueError(f"rows and columns must be at least 1, got {rows} and {columns}")
    count = rows * columns
    if metric is None:
        metric = np.tile(np.eye(4, dtype=np.float32), (len(shape.planes), 1, 1))
    kind = arrays.kind_of(endpoint_grid, device)
    place = kind.device
    wide, taken = place.is_cpu, []
    for name, grid, net, network in (
        ("endpoint", endpoint_grid, endpoint_net, shape.endpoint),
        ("texel", texel_grid, texel_net, shape.texel),
    ):
        taken.append(arrays.take(grid, f"{name}_grid", (network.grid_words,), wp.float32, kind))
        weights = arrays.take(net, f"{name}_net", (network.weights,), wp.float32, kind)
        if wide:
            # Warp's memory is aligned to cache lines, NumPy's is not: weights that straddle them cost a sixth of the
            # speed. So the copy is Warp's.
            weights = wp.clone(wp.array(network.layout.folded(weights.numpy()), dtype=wp.float32, device=place))
        taken.append(weights)
    tables = [
        arrays.take(net.table(), "table", (None, 3), wp.int32, kind).flatten() for net in (shape.endpoint, shape.texel)
    ]
    metric = arrays.take(metric, "metric", (len(shape.planes), 4, 4), wp.float32, kind)
    sizes = [FORMATS[name][0] for name, _ in shape.planes]
    written = kind.empty((sum(sizes) * count,), wp.uint8)
    colours = kind.empty((count, shape.channels, 16) if predicted else (1, 1, 1), wp.float32)
    own = _scratch(shape.endpoint.layout, shape.texel.layout)
    scratch = wp.empty(dispatch.worker_count() * own if wide else 1, dtype=wp.float32, device=place)
    dispatch.launch(
        make_blocks_kernel(shape, wide),
        dispatch.blocks(count, PATCH) if wide else count,
        inputs=[
            count, rows, columns, int(predicted), metric.flatten(), tables[0], taken[0], taken[1], tables[1], taken[2],
            taken[3], scratch,
        ],
        outputs=[written, colours.flatten()],
        device=place,
    )  # fmt: skip
    bytes_of, before, planes = kind.give(written), 0, []
    for size in sizes:
        planes.append(bytes_of[before * count : (before + size) * count].reshape((rows, columns, size)))
        before += size
    return (planes, kind.give(colours)) if predicted else planes
