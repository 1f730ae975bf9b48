"""Trilinear filtering of block-ordered textures for a block of lanes: wrap modes, taps, weights (BCf Eq. 10, 11).

A texture coordinate is brought into [0, 1] by its wrap mode; a texel's centre lies at (i + 0.5)/W, so u covers the
texels ⌊u W − 1/2⌋ and the next one, which ``repeat`` wraps around and ``clamp`` and ``mirror`` hold at the edge. A
coordinate that is not finite is 0, but ±∞ under ``clamp`` are the edges; a level that is not a number is 0.

This file writes C++ for ``wp.func_native``, with a hole for how a texel is fetched; :mod:`~.bcf_texel` fills it. Two
forms of the same arithmetic: the vector form finds the taps of 8 lanes at a time and then filters lane by lane, with
two texels in a register, because scalar loads beat the gathers of most cores. The scalar form serves CUDA, one lane a
thread, and CPUs without AVX2.

Textures are described by a level table, int32, :data:`RECORD` words each. Blocks of 4 × 4 texels lie row by row, mips
one after another; texel 4y + x of a block.
"""

import numpy as np

WRAPS = ("repeat", "clamp", "mirror")
"""Wrap modes."""

MOST_MIPS = 16
"""Mips that a texture may have: sides to 65535."""

RECORD = 4 + MOST_MIPS
"""Words of a texture in the level table: width, height, mips, bias as float bits, first block of mip 0 …"""


def level_table(sizes, biases, mips, first: int = 0) -> tuple[np.ndarray, int]:
    """Return the level table of textures that lie one after another, flat int32, and the block after the last.

    Args:
        sizes: (width, height) of each texture.
        biases: What is added to a sample's level for each texture.
        mips: Number of mips of each.
        first: Block at which the first texture begins.

    Raises: ValueError: If texels cannot be numbered in 31 bits, by the largest storage.
    """
    table = np.zeros((len(sizes), RECORD), np.int32)
    for row, (width, height), bias, count in zip(table, sizes, biases, mips, strict=True):
        row[:3] = width, height, count
        row[3:4].view(np.float32)[0] = bias
        for m in range(count):
            row[4 + m] = first
            first += -(-max(1, width >> m) // 4) * -(-max(1, height >> m) // 4)
    if first >= 1 << 25:
        raise ValueError(f"textures of one buffer must have fewer than 2^25 blocks of 4 x 4 texels, got {first}")
    return table.ravel(), first


def vector_code(textures: int, lanes: int, wrap: str, fetch: str) -> str:
    """Return C++ that filters ``textures`` textures for a block of lanes, on a CPU with AVX2.

    It reads ``u``, ``v``, ``lod`` (arrays of ``lanes``), ``count`` (lanes that are wanted), ``lv`` (level table), and
    writes ``x`` [3 textures][lanes]; lanes that are not wanted get anything finite.

    Args:
        textures: Number of textures.
        lanes: Lanes of the block, a multiple of 8.
        wrap: One of :data:`WRAPS`.
        fetch: C++ that defines how texels are numbered, PER_BLOCK · block + PER_TEXEL · (4y + x); ``place(number)``,
            the address to ask for ahead of time; and ``fetch(upper left, lower left, upper right, lower right,
            V& left, V& right)``: four numbers to two columns of texels, the upper one in the lower half.
    """
    return "\n".join([_TYPES, fetch, _vector_loop(textures, lanes, wrap)])


def scalar_code(textures: int, lanes: int, wrap: str, fetch: str) -> str:
    """Return plain C++, which is also CUDA, that does what :func:`vector_code` does.

    Here ``fetch(texel, float* rgb)`` takes texel 16 · block + 4y + x.
    """
    return "\n".join([fetch, _scalar_loop(textures, lanes, wrap)])


_TYPES = """
typedef float V __attribute__((vector_size(32), aligned(4), may_alias));
typedef int I __attribute__((vector_size(32), aligned(4), may_alias));
typedef unsigned int U __attribute__((vector_size(32), aligned(4), may_alias));
typedef float V4 __attribute__((vector_size(16), aligned(4), may_alias));
typedef short S8 __attribute__((vector_size(16), aligned(2), may_alias));
typedef short S16 __attribute__((vector_size(32), aligned(2), may_alias));
typedef long long L2 __attribute__((vector_size(16), aligned(8), may_alias));
typedef _Float16 H8 __attribute__((vector_size(16), aligned(2), may_alias));
typedef unsigned int u32 __attribute__((aligned(1), may_alias));
typedef unsigned long long u64 __attribute__((aligned(1), may_alias));
// Where 8 lanes read one texture: texel numbers of (upper left, lower left, upper right, lower right) in two mips.
struct alignas(32) Taps { int at[2][4][8]; float fx[2][8], upper[2][8], lower[2][8]; int sides; };
"""


_VECTOR_WRAP = {
    # A coordinate that is not a number fails every comparison.
    "repeat": "a -= __builtin_elementwise_floor(a); a = a >= 0.0f ? a : (V){};",
    "clamp": "a = a > 0.0f ? a : (V){}; a = a < 1.0f ? a : (V){} + 1.0f;",
    # Halved first, which is exact: a + 1 would not be for large a.
    "mirror": "a *= 0.5f; a -= __builtin_elementwise_floor(a); a = a >= 0.0f ? a + a : (V){};"
    " a = a > 1.0f ? 2.0f - a : a;",
}

_VECTOR_EDGE = {
    True: "x0 = x0 < 0 ? W - 1 : x0; x1 = x1 < W ? x1 : (I){};  y0 = y0 < 0 ? H - 1 : y0; y1 = y1 < H ? y1 : (I){};",
    False: "x0 = x0 < 0 ? (I){} : x0; x1 = x1 < W ? x1 : W - 1; y0 = y0 < 0 ? (I){} : y0; y1 = y1 < H ? y1 : H - 1;",
}


def _vector_loop(textures: int, lanes: int, wrap: str) -> str:
    return f"""
alignas(32) float uv[2 * {lanes}];
const int groups = (count + 7) >> 3;
for (int g = 0; g < groups; ++g) {{
    V a = *(const V*)(u.data + 8 * g); {_VECTOR_WRAP[wrap]} *(V*)(uv + 8 * g) = a;
    a = *(const V*)(v.data + 8 * g); {_VECTOR_WRAP[wrap]} *(V*)(uv + {lanes} + 8 * g) = a;
}}
for (int k = 8 * groups; k < {lanes}; ++k) for (int c = 0; c < {3 * textures}; ++c) x.data[c * {lanes} + k] = 0.0f;
_Pragma("clang loop unroll(disable)")
for (int t = 0; t < {textures}; ++t) {{
    const int* const rec = lv + {RECORD} * t;
    const int w0 = rec[0], h0 = rec[1], top = rec[2] - 1;
    const float bias = *(const float*)(rec + 3);
    float* const out = x.data + 3 * {lanes} * t;
    // The taps of a group are found, and their lines asked for, while the group before it is filtered.
    Taps ring[2];
    for (int turn = 0; turn <= groups; ++turn) {{
        if (turn < groups) {{
            const int g = turn;
            Taps& to = ring[turn & 1];
            V s = *(const V*)(lod.data + 8 * g) + bias;
            s = s > 0.0f ? s : (V){{}};
            s = s < (float)top ? s : (V){{}} + (float)top;
            const I m = __builtin_convertvector(s, I);
            const V part = s - __builtin_convertvector(m, V);
            to.sides = __builtin_ia32_movmskps256(part > 0.0f) ? 2 : 1;
            for (int side = 0; side < to.sides; ++side) {{
                I k = m + side; k = k < top ? k : (I){{}} + top;
                I W = ((I){{}} + w0) >> k; W = W > 1 ? W : (I){{}} + 1;
                I H = ((I){{}} + h0) >> k; H = H > 1 ? H : (I){{}} + 1;
                const I base = {{rec[4 + k[0]], rec[4 + k[1]], rec[4 + k[2]], rec[4 + k[3]],
                                 rec[4 + k[4]], rec[4 + k[5]], rec[4 + k[6]], rec[4 + k[7]]}};
                const V px = *(const V*)(uv + 8 * g) * __builtin_convertvector(W, V) - 0.5f;
                const V py = *(const V*)(uv + {lanes} + 8 * g) * __builtin_convertvector(H, V) - 0.5f;
                const V ix = __builtin_elementwise_floor(px), iy = __builtin_elementwise_floor(py);
                I x0 = __builtin_convertvector(ix, I), y0 = __builtin_convertvector(iy, I), x1 = x0 + 1, y1 = y0 + 1;
                {_VECTOR_EDGE[wrap == "repeat"]}
                const I pitch = (W + 3) >> 2;
                x0 = (x0 >> 2) * PER_BLOCK + (x0 & 3) * PER_TEXEL; x1 = (x1 >> 2) * PER_BLOCK + (x1 & 3) * PER_TEXEL;
                y0 = (base + (y0 >> 2) * pitch) * PER_BLOCK + (y0 & 3) * (4 * PER_TEXEL);
                y1 = (base + (y1 >> 2) * pitch) * PER_BLOCK + (y1 & 3) * (4 * PER_TEXEL);
                *(I*)to.at[side][0] = y0 + x0; *(I*)to.at[side][1] = y1 + x0;
                *(I*)to.at[side][2] = y0 + x1; *(I*)to.at[side][3] = y1 + x1;
                const V share = side ? part : 1.0f - part, fy = py - iy;
                *(V*)to.fx[side] = px - ix; *(V*)to.upper[side] = (1.0f - fy) * share;
                *(V*)to.lower[side] = fy * share;
                for (int i = 0; i < 8; ++i) {{
                    __builtin_prefetch(place(to.at[side][0][i])); __builtin_prefetch(place(to.at[side][3][i]));
                }}
            }}
        }}
        if (turn == 0) continue;
        const int g = turn - 1;
        const Taps& from = ring[g & 1];
        alignas(32) float texel[8][4];
        for (int i = 0; i < 8; ++i) {{
            V4 sum = {{}};
            for (int side = 0; side < from.sides; ++side) {{
                V left, right;
                fetch(from.at[side][0][i], from.at[side][1][i], from.at[side][2][i], from.at[side][3][i], left, right);
                const V both = left + (right - left) * from.fx[side][i];
                sum += __builtin_shufflevector(both, both, 0, 1, 2, 3) * from.upper[side][i];
                sum += __builtin_shufflevector(both, both, 4, 5, 6, 7) * from.lower[side][i];
            }}
            *(V4*)texel[2 * (i & 3) + (i >> 2)] = sum;
        }}
        const V a = *(const V*)texel[0], b = *(const V*)texel[2], c = *(const V*)texel[4], d = *(const V*)texel[6];
        const V ab = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
        const V cd = __builtin_shufflevector(c, d, 0, 8, 1, 9, 4, 12, 5, 13);
        const V ab2 = __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
        const V cd2 = __builtin_shufflevector(c, d, 2, 10, 3, 11, 6, 14, 7, 15);
        *(V*)(out + 8 * g) = __builtin_shufflevector(ab, cd, 0, 1, 8, 9, 4, 5, 12, 13);
        *(V*)(out + {lanes} + 8 * g) = __builtin_shufflevector(ab, cd, 2, 3, 10, 11, 6, 7, 14, 15);
        *(V*)(out + 2 * {lanes} + 8 * g) = __builtin_shufflevector(ab2, cd2, 0, 1, 8, 9, 4, 5, 12, 13);
    }}
}}
"""


_SCALAR_WRAP = {
    "repeat": "a -= floorf(a); if (!(a >= 0.0f)) a = 0.0f;",
    "clamp": "if (!(a > 0.0f)) a = 0.0f; if (!(a < 1.0f)) a = 1.0f;",
    "mirror": "a *= 0.5f; a -= floorf(a); a = a >= 0.0f ? a + a : 0.0f; if (a > 1.0f) a = 2.0f - a;",
}

_SCALAR_EDGE = {
    True: "a0 = a0 < 0 ? size - 1 : a0; a1 = a1 < size ? a1 : 0;",
    False: "a0 = a0 < 0 ? 0 : a0; a1 = a1 < size ? a1 : size - 1;",
}


def _scalar_loop(textures: int, lanes: int, wrap: str) -> str:
    return f"""
auto wrapped = [](float a) -> float {{ {_SCALAR_WRAP[wrap]} return a; }};
auto taps = [](float a, int size, int& a0, int& a1) -> float {{
    const float p = a * (float)size - 0.5f, whole = floorf(p);
    a0 = (int)whole; a1 = a0 + 1;
    {_SCALAR_EDGE[wrap == "repeat"]}
    return p - whole;
}};
for (int l = 0; l < {lanes}; ++l) {{
    const bool used = l < count;
    const float a = used ? wrapped(u.data[l]) : 0.0f, b = used ? wrapped(v.data[l]) : 0.0f;
    for (int t = 0; t < {textures}; ++t) {{
        float sum[3] = {{0.0f, 0.0f, 0.0f}};
        const int* rec = lv + {RECORD} * t;
        const int top = rec[2] - 1;
        float bias; memcpy(&bias, rec + 3, 4);
        float s = used ? lod.data[l] + bias : 0.0f;
        if (!(s > 0.0f)) s = 0.0f;
        if (!(s < (float)top)) s = (float)top;
        const int m = (int)s;
        const float part = s - (float)m;
        for (int side = 0; used && side < (part > 0.0f ? 2 : 1); ++side) {{
            const int k = m + side < top ? m + side : top;
            const int W = (rec[0] >> k) > 1 ? rec[0] >> k : 1, H = (rec[1] >> k) > 1 ? rec[1] >> k : 1;
            int x0, x1, y0, y1;
            const float fx = taps(a, W, x0, x1), fy = taps(b, H, y0, y1);
            const int pitch = (W + 3) >> 2, first = rec[4 + k];
            const int c0 = ((x0 >> 2) << 4) + (x0 & 3), c1 = ((x1 >> 2) << 4) + (x1 & 3);
            const int r0 = ((first + (y0 >> 2) * pitch) << 4) + ((y0 & 3) << 2);
            const int r1 = ((first + (y1 >> 2) * pitch) << 4) + ((y1 & 3) << 2);
            float p[4][3];
            fetch(r0 + c0, p[0]); fetch(r0 + c1, p[1]); fetch(r1 + c0, p[2]); fetch(r1 + c1, p[3]);
            const float share = side ? part : 1.0f - part, upper = (1.0f - fy) * share, lower = fy * share;
            for (int c = 0; c < 3; ++c) {{
                sum[c] += (p[0][c] + (p[1][c] - p[0][c]) * fx) * upper;
                sum[c] += (p[2][c] + (p[3][c] - p[2][c]) * fx) * lower;
            }}
        }}
        for (int c = 0; c < 3; ++c) x.data[(3 * t + c) * {lanes} + l] = sum[c];
    }}
}}
"""
