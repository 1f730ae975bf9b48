"""NTBC's network at any positions, forward and backward, with grid look-ups and layers in one pass (NTBC §3.4).

The general form of what ``ntbc_train`` does for blocks: a *patch* of :data:`PATCH` positions goes through the network
of ``ntbc_network`` in a scratch that stays in the core's cache. The backward pass runs the forward one again, so that
nothing is kept between them. One kernel serves both: without gradients to come in, outputs go out. Gradients are summed
in one buffer per *part*, a fixed share of the patches in a fixed order. CPU only.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.ntbc_network import HEAD, Layout, NetworkCode, NetworkShape

PATCH = 128
"""Positions that go through the network at once."""


def scratch(layout: Layout) -> int:
    """Return the float32 words of scratch that a part needs."""
    return NetworkCode(layout, "N", PATCH).scratch() + 64


def _cpu_code(layout: Layout) -> str:
    code, wide = NetworkCode(layout, "N", PATCH), layout.rows[-1]
    return f"""{HEAD}
    const float* const N_net = net.data; const float* const N_grid = grid.data; const int* const N_table = table.data;
    float* const N_net_gradient = net_gradient.data + (long long)part * {layout.weights};
    float* const N_grid_gradient = grid_gradient.data + (long long)part * words;
    float* at = scratch.data + (long long)part * {scratch(layout)};
    at += (16 - ((unsigned long long)at / 4) % 16) % 16;
    {code.declare()}
    for (int patch = part; patch * {PATCH} < count; patch += parts) {{
        const int filled = count - patch * {PATCH} < {PATCH} ? count - patch * {PATCH} : {PATCH};
        const float* const places = positions.data + 2ll * {PATCH} * patch;
        // Rows past the last position hold whatever they held; no result is taken from them, and their gradient is 0.
        {code.gather(code.positions)} {code.forward()}
        const long long first = (long long)patch * {PATCH} * {layout.outputs};
        if (!backward) {{
            for (int l = 0; l < filled; ++l) for (int c = 0; c < {layout.outputs}; ++c)
                outputs.data[first + l * {layout.outputs} + c] = N_Y[l * {wide} + c];
            continue;
        }}
        for (int i = 0; i < {PATCH * wide}; ++i) N_D[i] = 0.0f;
        for (int l = 0; l < filled; ++l) for (int c = 0; c < {layout.outputs}; ++c) {{
            const float y = N_Y[l * {wide} + c];
            N_D[l * {wide} + c] = gradient.data[first + l * {layout.outputs} + c] * y * (1.0f - y);
        }}
        {code.backward()} {code.scatter(code.positions)}
    }}"""


@functools.cache
def _make_kernel(layout: Layout):
    @wp.func_native(_cpu_code(layout))
    def rows_part(
        part: int,
        parts: int,
        count: int,
        words: int,
        backward: int,
        positions: wp.array(dtype=wp.float32),
        table: wp.array(dtype=wp.int32),
        grid: wp.array(dtype=wp.float32),
        net: wp.array(dtype=wp.float32),
        gradient: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        outputs: wp.array(dtype=wp.float32),
        grid_gradient: wp.array(dtype=wp.float32),
        net_gradient: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def ntbc_rows_kernel(
        first: int,
        parts: int,
        count: int,
        words: int,
        backward: int,
        positions: wp.array(dtype=wp.float32),
        table: wp.array(dtype=wp.int32),
        grid: wp.array(dtype=wp.float32),
        net: wp.array(dtype=wp.float32),
        gradient: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        outputs: wp.array(dtype=wp.float32),
        grid_gradient: wp.array(dtype=wp.float32),
        net_gradient: wp.array(dtype=wp.float32),
    ):
        rows_part(
            first + wp.tid(), parts, count, words, backward, positions, table, grid, net, gradient, scratch, outputs,
            grid_gradient, net_gradient,
        )  # fmt: skip

    return ntbc_rows_kernel


def make_rows_kernel(shape: NetworkShape):
    """Return the kernel of a network, forward or backward; one thread is one part, levels may have any size."""
    return _make_kernel(shape.layout)
