"""The trainable block texture: parameters of BC6H blocks in, texels out, and the gradient back (BCf §4, Eq. 6–9).

A block of 4 × 4 texels holds four endpoints (two a region), sixteen positions x in [0, 1] and a partition. Endpoints
are kept as u = y / 31744, with y the half-float bit pattern read as a number, so unsigned textures have u in [0, 1) and
signed ones u in (−1, 1). A texel is y = y_a + x (y_b − y_a) (Eq. 8), read again as a half float (Eq. 9, with |y| and
the sign put back; the smooth continuation between bit patterns is linear in each octave).

A block whose ``mode`` is 0 is continuous. In mode 1 … 14 it goes through that mode's quantisation first: endpoints to
the mode's codes and its range of differences, positions to 3- or 4-bit weights, then the integer arithmetic of the
decoder, so that the texels are exactly those that any BC6H decoder gives for the block. Its gradient is that of the
continuous block at the quantised values (straight-through). Shape 32 stands for one region.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.bc6h_tables import MODES, PARTITIONS, WEIGHTS3, WEIGHTS4

ONE_REGION = 32
"""Shape of a block with one region; 0 … 31 are the partitions."""

SPAN = 31744.0
"""Half-float bit patterns that an endpoint of 1 reaches past."""


def _row(values) -> str:
    return "{" + ", ".join(str(int(v)) for v in values) + "}"


def _tables() -> str:
    """C++ tables of the format, index 0 standing for a continuous block."""
    masks = [*PARTITIONS, 0]
    return (
        f"const int masks[33] = {_row(masks)};"
        f"const int precisions[15] = {_row([0, *(m.precision for m in MODES)])};"
        f"const int transforms[15] = {_row([0, *(m.transformed for m in MODES)])};"
        f"const int deltas[15][3] = {{ {{0, 0, 0}}, {', '.join(_row(m.delta) for m in MODES)} }};"
        f"const int weights3[8] = {_row(WEIGHTS3)}; const int weights4[16] = {_row(WEIGHTS4)};"
    )


# Endpoints as y (float, exact for quantised ones), positions as weights; used by both directions.
_QUANTISE = """
float E[4][3]; float X[16]; float R[16];
const int shape = shapes.data[block], mode = modes.data[block], mask = masks[shape];
const float* const e = endpoints.data + 12ll * block;
const float* const p = positions.data + 16ll * block;
for (int t = 0; t < 16; ++t) R[t] = (float)((mask >> t) & 1);
int U[4][3];
if (mode == 0) {
    for (int k = 0; k < 4; ++k) for (int c = 0; c < 3; ++c) {
        const float u = e[3 * k + c];
        E[k][c] = 31744.0f * (u < low ? low : (u > 0.99996850f ? 0.99996850f : u));
    }
    for (int t = 0; t < 16; ++t) X[t] = p[t] < 0.0f ? 0.0f : (p[t] > 1.0f ? 1.0f : p[t]);
} else {
    const int bits = precisions[mode], steps = shape == 32 ? 15 : 7;
    int index0 = 0;
    for (int t = 0; t < 16; ++t) {
        const float x = p[t] < 0.0f ? 0.0f : (p[t] > 1.0f ? 1.0f : p[t]);
        const int index = (int)(x * (float)steps + 0.5f);
        if (t == 0) index0 = index;
        X[t] = (float)(shape == 32 ? weights4[index] : weights3[index]);
    }
    // The anchor's index must lie in the lower half: else its region's endpoints are stored the other way round, and
    // the other endpoint is the one that differences start from.
    const int root = 2 * index0 > steps ? 1 : 0;
    const int most = is_signed ? (1 << (bits - 1)) - 1 : (1 << bits) - 1, least = is_signed ? -most : 0;
    const int endpoint_count = shape == 32 ? 2 : 4;
    for (int c = 0; c < 3; ++c) {
        int code[4];
        for (int k = 0; k < 4; ++k) {
            const float u = e[3 * k + c];
            // A code stands for the middle of its interval; the outermost ones stand for the ends of the range.
            const float scaled = is_signed ? u * (float)(1 << (bits - 1)) : u * (float)(1 << bits);
            const float nearest = bits > 14 ? (scaled < 0.0f ? scaled - 0.5f : scaled + 0.5f) : scaled;
            const int q = (int)nearest;  // towards zero, as the intervals of signed codes lie
            code[k] = q < least ? least : (q > most ? most : q);
        }
        if (transforms[mode]) {
            const int reach = 1 << (deltas[mode][c] - 1);
            for (int k = 0; k < endpoint_count; ++k) {
                int d = code[k] - code[root];
                d = d < -reach ? -reach : (d > reach - 1 ? reach - 1 : d);
                code[k] = code[root] + d;
            }
        }
        for (int k = 0; k < 4; ++k) {
            const int q = code[k], m = q < 0 ? -q : q;
            int v;
            if (is_signed) {
                v = bits > 15 ? m : (m == 0 ? 0 : (m >= most ? 0x7FFF : ((m << 15) + 0x4000) >> (bits - 1)));
                v = q < 0 ? -v : v;
            } else {
                v = bits > 14 ? m : (m == 0 ? 0 : (m == most ? 0xFFFF : ((m << 16) + 0x8000) >> bits));
            }
            U[k][c] = v;
            E[k][c] = (float)v * (is_signed ? 0.96875f : 0.484375f);
        }
    }
}
"""

_HALF = """
// The value of half bits y, and its slope (Eq. 9).
auto value = [](float y) {
    const float m = y < 0.0f ? -y : y;
    union { int i; float f; } v; v.i = (int)(m * 8192.0f) + (112 << 23);
    const float w = m < 1024.0f ? m * 5.9604645e-8f : v.f;
    return y < 0.0f ? -w : w;
};
auto slope = [](float y) {
    const float m = y < 0.0f ? -y : y;
    union { int i; float f; } v; v.i = (((int)m >> 10) + 102) << 23;
    return m < 1024.0f ? 5.9604645e-8f : v.f;
};
"""

_FORWARD = """
float* const out = texels.data + 64ll * block;
float W[3][16];
for (int c = 0; c < 3; ++c) {
    if (mode == 0) {
        const float a0 = E[0][c], a1 = E[2][c], d0 = E[1][c] - a0, d1 = E[3][c] - a1;
        for (int t = 0; t < 16; ++t) W[c][t] = value((R[t] > 0.0f ? a1 : a0) + X[t] * (R[t] > 0.0f ? d1 : d0));
    } else {
        const int a0 = U[0][c], a1 = U[2][c], b0 = U[1][c], b1 = U[3][c];
        for (int t = 0; t < 16; ++t) {
            const int a = R[t] > 0.0f ? a1 : a0, b = R[t] > 0.0f ? b1 : b0, w = (int)X[t];
            int v = (a * (64 - w) + b * w + 32) >> 6;
            if (is_signed) v = v < 0 ? -(((-v) * 31) >> 5) : (v * 31) >> 5;
            else v = (v * 31) >> 6;
            W[c][t] = value((float)v);
        }
    }
}
for (int t = 0; t < 16; ++t) {
    out[4 * t] = W[0][t]; out[4 * t + 1] = W[1][t]; out[4 * t + 2] = W[2][t]; out[4 * t + 3] = 0.0f;
}
"""

# Samples of a step touch about a third of the blocks; of the others nothing is done but to see that.
_SUM = """
float GW[64];
int touched = 0;
const float* const given = gradients.data + 64ll * block;
for (int i = 0; i < 64; ++i) GW[i] = given[i];
for (int q = 1; q < parts; ++q) for (int i = 0; i < 64; ++i) GW[i] += given[64ll * count * q + i];
for (int i = 0; i < 64; ++i) touched |= GW[i] != 0.0f;
if (!touched) {
    for (int k = 0; k < 12; ++k) endpoint_gradient.data[12ll * block + k] = 0.0f;
    for (int t = 0; t < 16; ++t) position_gradient.data[16ll * block + t] = 0.0f;
    return;
}
"""

_BACKWARD = """
const float scale = mode == 0 ? 1.0f : 0.015625f;
for (int t = 0; t < 16; ++t) X[t] *= scale;
float GX[16]; float GE[4][3];
for (int t = 0; t < 16; ++t) GX[t] = 0.0f;
for (int c = 0; c < 3; ++c) {
    const float a0 = E[0][c], a1 = E[2][c], d0 = E[1][c] - a0, d1 = E[3][c] - a1;
    float A[16]; float B[16];
    for (int t = 0; t < 16; ++t) {
        const float d = R[t] > 0.0f ? d1 : d0;
        const float y = (R[t] > 0.0f ? a1 : a0) + X[t] * d;
        const float g = GW[4 * t + c] * slope(y);
        GX[t] += g * d;
        B[t] = g * X[t];
        A[t] = g - B[t];
    }
    float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f;
    for (int t = 0; t < 16; ++t) {
        const float r = R[t];
        s0 += A[t] * (1.0f - r); s1 += B[t] * (1.0f - r); s2 += A[t] * r; s3 += B[t] * r;
    }
    GE[0][c] = 31744.0f * s0; GE[1][c] = 31744.0f * s1; GE[2][c] = 31744.0f * s2; GE[3][c] = 31744.0f * s3;
}
for (int k = 0; k < 4; ++k) for (int c = 0; c < 3; ++c) endpoint_gradient.data[12ll * block + 3 * k + c] = GE[k][c];
for (int t = 0; t < 16; ++t) position_gradient.data[16ll * block + t] = GX[t];
"""


@functools.cache
def make_block_kernels():
    """Return the kernels (forward, backward) of the trainable block texture; one thread is one block."""

    @wp.func_native(_tables() + "const float low = is_signed ? -0.99996850f : 0.0f;" + _HALF + _QUANTISE + _FORWARD)
    def decode_block(
        block: int,
        is_signed: int,
        endpoints: wp.array(dtype=wp.float32),
        positions: wp.array(dtype=wp.float32),
        shapes: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        texels: wp.array(dtype=wp.float32),
    ): ...

    @wp.func_native(
        _SUM + _tables() + "const float low = is_signed ? -0.99996850f : 0.0f;" + _HALF + _QUANTISE + _BACKWARD
    )
    def adjoint_block(
        block: int,
        count: int,
        parts: int,
        is_signed: int,
        endpoints: wp.array(dtype=wp.float32),
        positions: wp.array(dtype=wp.float32),
        shapes: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        gradients: wp.array(dtype=wp.float32),
        endpoint_gradient: wp.array(dtype=wp.float32),
        position_gradient: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def block_decode_kernel(
        first: int,
        is_signed: int,
        endpoints: wp.array(dtype=wp.float32),
        positions: wp.array(dtype=wp.float32),
        shapes: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        # outputs
        texels: wp.array(dtype=wp.float32),
    ):
        decode_block(first + wp.tid(), is_signed, endpoints, positions, shapes, modes, texels)

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def block_adjoint_kernel(
        first: int,
        count: int,
        parts: int,
        is_signed: int,
        endpoints: wp.array(dtype=wp.float32),
        positions: wp.array(dtype=wp.float32),
        shapes: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        gradients: wp.array(dtype=wp.float32),
        # outputs
        endpoint_gradient: wp.array(dtype=wp.float32),
        position_gradient: wp.array(dtype=wp.float32),
    ):
        adjoint_block(
            first + wp.tid(), count, parts, is_signed, endpoints, positions, shapes, modes, gradients,
            endpoint_gradient, position_gradient,
        )  # fmt: skip

    return block_decode_kernel, block_adjoint_kernel
