"""Trilinear filtering of block-ordered textures for a block of lanes: wrap modes, taps, weights (BCf Eq. 10, 11).

A texture coordinate is brought into [0, 1] by its wrap mode; a texel's centre lies at (i + 0.5)/W, so u covers the
texels ⌊u W − 1/2⌋ and the next one, which ``repeat`` wraps around and ``clamp`` and ``mirror`` hold at the edge. A
coordinate that is not finite is 0, but ±∞ under ``clamp`` are the edges; a level that is not a number is 0.

This file writes C++ for ``wp.func_native``, with a hole for how a texel is fetched; :mod:`~.bcf_texel` fills it. Two
forms of the same arithmetic: the vector form finds the taps of 8 lanes at a time and asks for their cache lines, which
is what random places wait for, four groups before it filters them lane by lane, with the two texels of a row in a
register, because scalar loads beat the gathers of most cores. The scalar form serves CUDA, one lane a thread, and CPUs
without AVX2 and BMI2.

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


def vector_code(textures: int, lanes: int, wrap: str, fetch: str, *, paired: bool = False) -> str:
    """Return C++ that filters ``textures`` textures for a block of lanes, on a CPU with AVX2 and BMI2.

    It reads ``u``, ``v``, ``lod`` (arrays of ``lanes``), ``count`` (lanes that are wanted), ``lv`` (level table), and
    writes ``x`` [3 textures][lanes]; lanes that are not wanted get anything finite.

    Args:
        textures: Number of textures.
        lanes: Lanes of the block, a multiple of 8.
        wrap: One of :data:`WRAPS`.
        fetch: C++ that defines ``COLUMN(x)`` and ``ROW(y)``, what a texel's place adds to its number beside
            PER_BLOCK · block; ``place(number)``, the address to ask for ahead of time; ``prepare(taps)``, called once
            for each group; and ``rows(taps, side, lane, V& upper, V& lower)``: the two texels of each row of a
            footprint, the left one in the lower half.
        paired: Whether the storage keeps a texel's right neighbour beside it, so that only the left one is numbered;
            channels then lie in words 1 to 3 of the left half and 0 to 2 of the right, else in 0 to 2 of both.
    """
    return "\n".join([_types(paired), fetch, _vector_loop(textures, lanes, wrap, paired)])


def scalar_code(textures: int, lanes: int, wrap: str, fetch: str) -> str:
    """Return plain C++, which is also CUDA, that does what :func:`vector_code` does.

    Here ``fetch(texel, float* rgb)`` takes texel 16 · block + 4y + x.
    """
    return "\n".join([fetch, _scalar_loop(textures, lanes, wrap)])


def _types(paired: bool) -> str:
    numbered = 2 if paired else 4
    return f"""
typedef float V __attribute__((vector_size(32), aligned(4), may_alias));
typedef int I __attribute__((vector_size(32), aligned(4), may_alias));
typedef unsigned int U __attribute__((vector_size(32), aligned(4), may_alias));
typedef double D4 __attribute__((vector_size(32), aligned(8), may_alias));
typedef short S8 __attribute__((vector_size(16), aligned(2), may_alias));
typedef short S16 __attribute__((vector_size(32), aligned(2), may_alias));
typedef long long L2 __attribute__((vector_size(16), aligned(8), may_alias));
typedef long long L4 __attribute__((vector_size(32), aligned(8), may_alias));
typedef unsigned char B8 __attribute__((vector_size(8), aligned(1), may_alias));
typedef unsigned char B16 __attribute__((vector_size(16), aligned(1), may_alias));
typedef unsigned char B32 __attribute__((vector_size(32), aligned(1), may_alias));
typedef char C16 __attribute__((vector_size(16), aligned(1), may_alias));
typedef char C32 __attribute__((vector_size(32), aligned(1), may_alias));
typedef _Float16 H8 __attribute__((vector_size(16), aligned(2), may_alias));
typedef unsigned int u32 __attribute__((aligned(1), may_alias));
typedef unsigned long long u64 __attribute__((aligned(1), may_alias));
typedef double f64 __attribute__((aligned(4), may_alias));
// Hides from the compiler how a vector came about: it would merge two cheap shuffles into one that costs more.
#define FILTER_KEEP(v) __asm__("" : "+x"(v))
// Where 8 lanes read one texture: texel numbers in two mips, upper row first, and the weights of (left, right) texels.
struct alignas(32) Taps {{ int at[2][{numbered}][8]; float w[2][2][16]; int sides; }};
"""


_VECTOR_WRAP = {
    # A coordinate that is not a number fails every comparison.
    "repeat": "a -= __builtin_elementwise_floor(a); a = a >= 0.0f ? a : (V){};",
    "clamp": "a = a > 0.0f ? a : (V){}; a = a < 1.0f ? a : (V){} + 1.0f;",
    # Halved first, which is exact: a + 1 would not be for large a.
    "mirror": "a *= 0.5f; a -= __builtin_elementwise_floor(a); a = a >= 0.0f ? a + a : (V){};"
    " a = a > 1.0f ? 2.0f - a : a;",
}

_AHEAD = 4  # groups between asking for a cache line and reading it

# Holding a place within the texels' centres is the same as holding its texels within the texture.
_HOLD = "p{0} = p{0} > 0.0f ? p{0} : (V){{}}; p{0} = p{0} < last{0} ? p{0} : last{0};"


def _vector_loop(textures: int, lanes: int, wrap: str, paired: bool) -> str:
    repeat = wrap == "repeat"
    hold = "" if repeat else _HOLD.format("x") + _HOLD.format("y")
    low, high = ("x0 = x0 < 0 ? W - 1 : x0; y0 = y0 < 0 ? H - 1 : y0;", "(I){{}}") if repeat else ("", "{0} - 1")
    numbers = """
                const I column = (x0 >> 2) * PER_BLOCK + COLUMN(x0);
                *(I*)to.at[side][0] = upper + column; *(I*)to.at[side][1] = lower + column;"""
    if not paired:
        numbers = f"""
                I x1 = x0 + 1; x1 = x1 < W ? x1 : {high.format("W")};
                const I left = (x0 >> 2) * PER_BLOCK + COLUMN(x0), right = (x1 >> 2) * PER_BLOCK + COLUMN(x1);
                *(I*)to.at[side][0] = upper + left; *(I*)to.at[side][1] = upper + right;
                *(I*)to.at[side][2] = lower + left; *(I*)to.at[side][3] = lower + right;"""
    ends = (0, 1) if paired else (0, 3)
    ask = " ".join(f"__builtin_prefetch(place(to.at[side][{k}][i]));" for k in ends)
    # The right texels' channels move to where the left ones' are; then words 1, 2, 3 or 0, 1, 2 hold them.
    turn = "b[k] = __builtin_shufflevector(b[k], b[k], 0, 0, 1, 2, 4, 4, 5, 6);" if paired else ""
    first = 1 if paired else 0
    channels = []
    for c in range(3):
        word = first + c
        half, odd = ("low", "high")[word // 2], 2 * (word % 2)
        order = ", ".join(str(4 * q + odd + e + o) for q in range(2) for o in (0, 8) for e in range(2))
        channels.append(f"*(V*)(out + {c * lanes} + 8 * g) = __builtin_shufflevector({half}0, {half}1, {order});")
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
    // The taps of a group are found, and their lines asked for, while groups before it are filtered.
    Taps ring[{2 * _AHEAD}];
    for (int turn = 0; turn < groups + {_AHEAD}; ++turn) {{
        if (turn < groups) {{
            const int g = turn;
            Taps& to = ring[turn & {2 * _AHEAD - 1}];
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
                const I base = k < 8 ? (I)__builtin_ia32_permvarsi256(*(const I*)(rec + 4), k)
                                     : (I)__builtin_ia32_permvarsi256(*(const I*)(rec + 12), k);
                const V sizex = __builtin_convertvector(W, V), sizey = __builtin_convertvector(H, V);
                const V lastx = sizex - 1.0f, lasty = sizey - 1.0f;
                V px = *(const V*)(uv + 8 * g) * sizex - 0.5f, py = *(const V*)(uv + {lanes} + 8 * g) * sizey - 0.5f;
                {hold}
                const V ix = __builtin_elementwise_floor(px), iy = __builtin_elementwise_floor(py);
                I x0 = __builtin_convertvector(ix, I), y0 = __builtin_convertvector(iy, I);
                {low}
                I y1 = y0 + 1; y1 = y1 < H ? y1 : {high.format("H")};
                const I pitch = (W + 3) >> 2;
                const I upper = (base + (y0 >> 2) * pitch) * PER_BLOCK + ROW(y0);
                const I lower = (base + (y1 >> 2) * pitch) * PER_BLOCK + ROW(y1);
                {numbers}
                const V fx = px - ix, share = side ? part : 1.0f - part, below = (py - iy) * share;
                const V above = share - below, above1 = fx * above, below1 = fx * below;
                const V above0 = above - above1, below0 = below - below1;
                float* const w = to.w[side][0];
                *(V*)w = __builtin_shufflevector(above0, above1, 0, 8, 1, 9, 4, 12, 5, 13);
                *(V*)(w + 8) = __builtin_shufflevector(above0, above1, 2, 10, 3, 11, 6, 14, 7, 15);
                *(V*)(w + 16) = __builtin_shufflevector(below0, below1, 0, 8, 1, 9, 4, 12, 5, 13);
                *(V*)(w + 24) = __builtin_shufflevector(below0, below1, 2, 10, 3, 11, 6, 14, 7, 15);
                __asm__ volatile("" ::: "memory");
                _Pragma("clang loop unroll(full)")
                for (int i = 0; i < 8; ++i) {{ {ask} }}
            }}
        }}
        if (turn < {_AHEAD}) continue;
        const int g = turn - {_AHEAD};
        const Taps& from = ring[g & {2 * _AHEAD - 1}];
        prepare(from);
        V sum[8];
        _Pragma("clang loop unroll(full)")
        for (int i = 0; i < 8; ++i) {{
            const int spot = (i & 1) | (i & 2) << 1 | (i & 4) >> 1;
            auto add = [&](int side, V into) __attribute__((always_inline)) {{
                V upper, lower;
                rows(from, side, i, upper, lower);
                auto weight = [&](int row) __attribute__((always_inline)) {{
                    const double two = *(const f64*)(from.w[side][row] + 2 * spot);
                    V w = (V)(D4){{two, two, two, two}};
                    FILTER_KEEP(w);
                    return __builtin_shufflevector(w, w, 0, 0, 0, 0, 5, 5, 5, 5);
                }};
                into += upper * weight(0);
                into += lower * weight(1);
                return into;
            }};
            sum[i] = add(0, (V){{}});
            if (from.sides == 2) sum[i] = add(1, sum[i]);
        }}
        V a[4], b[4];
        _Pragma("clang loop unroll(full)")
        for (int k = 0; k < 4; ++k) {{
            a[k] = __builtin_shufflevector(sum[k], sum[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
            b[k] = __builtin_shufflevector(sum[k], sum[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
            FILTER_KEEP(b[k]);
            {turn}
            a[k] += b[k];
        }}
        const V low0 = __builtin_shufflevector(a[0], a[1], 0, 8, 1, 9, 4, 12, 5, 13);
        const V low1 = __builtin_shufflevector(a[2], a[3], 0, 8, 1, 9, 4, 12, 5, 13);
        const V high0 = __builtin_shufflevector(a[0], a[1], 2, 10, 3, 11, 6, 14, 7, 15);
        const V high1 = __builtin_shufflevector(a[2], a[3], 2, 10, 3, 11, 6, 14, 7, 15);
        {" ".join(channels)}
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
