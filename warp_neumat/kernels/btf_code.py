"""C++ of a neural BTF for ``wp.func_native``: how lanes become items and rows, texture fetches, and the layers.

On the CPU a block's wanted lanes are arranged in *rows* of :data:`ROW` lanes that share no memory with each other, and
with a coarse network the rows in *groups*: a group is :data:`ROW` *items*, which the coarse network sees, and its row k
holds the k-th lane of each. An item is a quad, or one lane where a quad is none; items with many lanes come first, so
that rows are full. A row or group is a matrix [feature][ROW], and a layer a few outputs of it in registers.

Every generator writes for a register of ``vector`` floats; :func:`~.neubrdf_code.by_width` picks it.
"""

from warp_neumat.kernels.mlp import split_outputs

ROW = 16
"""Lanes of a row: two registers of AVX, one of AVX-512."""

SEAM = 4.0
"""A quad whose texels lie further apart than this [texels of its mip] is no quad: each lane is an item of its own."""

LEVEL = 6
"""Words of a mip in the level table: width, height and first 16 bytes of the fine texture, then of the coarse one."""

MOST = {16: 8, 8: 6, 4: 4}
"""Outputs of a layer whose sums are in registers at a time, by the floats of a register."""


def vector_types(vector: int) -> str:
    """Return the types that the other generators use."""
    return f"""
typedef float V __attribute__((vector_size({4 * vector}), aligned(4), may_alias)); enum {{ NV = {vector} }};
typedef float V8 __attribute__((vector_size(32), aligned(4), may_alias));
typedef float V4 __attribute__((vector_size(16), aligned(4), may_alias));
typedef int I8 __attribute__((vector_size(32), aligned(4), may_alias));
const V Z = {{}};
enum {{ ROW = {ROW} }};
// Makes directions x [3][ROW] unit; sums of unit directions above the horizon do not vanish.
auto unit = [](float* x) __attribute__((always_inline)) {{
    for (int i = 0; i < ROW; i += NV) {{
        const V p = *(V*)(x + i), q = *(V*)(x + ROW + i), r = *(V*)(x + 2 * ROW + i), d = p * p + q * q + r * r;
        const V s = 1.0f / __builtin_elementwise_sqrt(d > 1e-30f ? d : (V){{}} + 1e-30f);
        *(V*)(x + i) = p * s; *(V*)(x + ROW + i) = q * s; *(V*)(x + 2 * ROW + i) = r * s;
    }}
}};
// Folds four neighbouring lanes of 32 into one: eight quads.
auto fold = [](V8 a, V8 b, V8 c, V8 d, auto join) __attribute__((always_inline)) {{
    auto pairs = [&](V8 s, V8 t) __attribute__((always_inline)) {{
        return join(__builtin_shufflevector(s, t, 0, 2, 8, 10, 4, 6, 12, 14),
                    __builtin_shufflevector(s, t, 1, 3, 9, 11, 5, 7, 13, 15));
    }};
    const V8 all = pairs(pairs(a, b), pairs(c, d));
    return __builtin_shufflevector(all, all, 0, 4, 1, 5, 2, 6, 3, 7);
}};
auto plus = [](V8 s, V8 t) __attribute__((always_inline)) {{ return s + t; }};
auto least = [](V8 s, V8 t) __attribute__((always_inline)) {{ return s < t ? s : t; }};
"""


ACTIVATIONS = {
    "relu": "return s > {zero} ? s : {zero};",
    "hardswish": "const {type} t = s * 0.16666667f + 0.5f, low = t > {zero} ? t : {zero};"
    " return s * (low < {zero} + 1.0f ? low : {zero} + 1.0f);",
}
"""What a hidden layer does to its sums s: max(s, 0), or s · clamp(s/6 + 1/2, 0, 1)."""


def activation_code(name: str, kind: str) -> str:
    """Return C++ of ``act(s)`` for numbers of type ``kind``, ``V`` or ``float``."""
    body = ACTIVATIONS[name].format(type=kind, zero="V{}" if kind == "V" else "0.0f")
    return f"auto act = []({kind} s) __attribute__((always_inline)) {{ {body} }}; (void)act;"


def layer(inputs: int, outputs: int, weights: str, source: str, target: str, vector: int, *, hidden=True, start=None):
    """Return C++ of one layer over a row: ``target`` [outputs][ROW] from ``source`` [inputs][ROW].

    Args:
        inputs, outputs: Its size.
        weights: C++ of where its transposed weights [inputs][outputs] lie; without ``start``, its biases before them.
        source, target: C++ of pointers.
        vector: Floats of a register.
        hidden: Whether sums go through ``act``.
        start: C++ of what sums begin with, [outputs][ROW]; None = the biases; "0" = nothing.
    """
    registers = ROW // vector
    text = ["{"]
    for first, size, count in split_outputs(outputs, MOST[vector]):
        cells = [(b, u) for b in range(size) for u in range(registers)]
        text.append(f"for (int block = 0; block < {count}; ++block) {{ const int o = {first} + block * {size};")
        for b, u in cells:
            begin = {None: f"Z + ({weights})[o + {b}]", "0": "Z"}.get(
                start, f"*(const V*)({start} + (o + {b}) * {ROW} + {u} * NV)"
            )
            text.append(f"V a{b}_{u} = {begin};")
        text.append(f"const float* wk = ({weights}) + {0 if start else outputs} + o; const float* xk = {source};")
        text.append(f'_Pragma("clang loop unroll_count({8 if inputs % 8 == 0 else 4})")')
        text.append(f"for (int k = 0; k < {inputs}; ++k, wk += {outputs}, xk += {ROW}) {{")
        text += [f"const V x{u} = *(const V*)(xk + {u} * NV);" for u in range(registers)]
        for b in range(size):
            adds = "".join(f" a{b}_{u} += x{u} * s;" for u in range(registers))
            text.append(f"{{ const float s = wk[{b}];{adds} }}")
        text.append("}")
        for b, u in cells:
            value = f"act(a{b}_{u})" if hidden else f"a{b}_{u}"
            text.append(f"*(V*)({target} + (o + {b}) * {ROW} + {u} * NV) = {value};")
        text.append("}")
    return "\n".join([*text, "}"])


def batch(widest: int) -> int:
    """Return how many rows go through a layer before the next one: more hide the latency between the layers."""
    return 4 if widest <= 32 else 1


def tail(widths, weights: int, target: str, count: str, pitch: int, vector: int, *, hidden: bool) -> str:
    """Return C++ of the layers behind the first one, for rows 0 … ``count`` − 1 of the buffers h0 and h1, from h0 on.

    Args:
        widths: Of the first layer's outputs and of the layers behind it.
        weights: Word of ``w`` at which their biases and weights begin.
        target: C++ of where row t's results go.
        count: C++ of the number of rows.
        pitch: Words of a row in the buffers.
        vector: Floats of a register.
        hidden: Whether the results go through ``act``.
    """
    text, layers = [], list(zip(widths[:-1], widths[1:], strict=True))
    for n, (i, o) in enumerate(layers):
        last = n == len(layers) - 1
        source, to = f"(h{n % 2} + t * {pitch})", target if last else f"(h{1 - n % 2} + t * {pitch})"
        body = layer(i, o, f"(w + {weights})", source, to, vector, hidden=hidden if last else True)
        text.append(f"for (int t = 0; t < {count}; ++t) {body}")
        weights += o + i * o
    return "\n".join(text)


# ---- textures --------------------------------------------------------------------------------------------------------

TEXTURES = """
struct Taps { int base[ROW], at[4][ROW]; float w[4][ROW]; };
#if defined(__F16C__)
typedef _Float16 H8 __attribute__((vector_size(16), aligned(2), may_alias));
auto halves = [](const unsigned short* p) __attribute__((always_inline)) {
    return __builtin_convertvector(*(const H8*)p, V8);
};
#else
typedef unsigned short U8 __attribute__((vector_size(16), aligned(2), may_alias));
typedef unsigned int W8 __attribute__((vector_size(32)));
auto halves = [](const unsigned short* p) __attribute__((always_inline)) {
    const W8 bits = __builtin_convertvector(*(const U8*)p, W8);
    const V8 size = (V8)((bits & 0x7FFFu) << 13) * 5.192296858534828e33f;
    return (V8)((W8)size | (bits & 0x8000u) << 16);
};
#endif
auto transposed = [](const float* from, int pitch, float* to) __attribute__((always_inline)) {
    V8 r[8], s[8];
    for (int i = 0; i < 8; ++i) r[i] = *(const V8*)(from + i * pitch);
    for (int i = 0; i < 8; i += 2) {
        s[i] = __builtin_shufflevector(r[i], r[i + 1], 0, 8, 1, 9, 4, 12, 5, 13);
        s[i + 1] = __builtin_shufflevector(r[i], r[i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
    }
    for (int i = 0; i < 8; i += 4) for (int j = 0; j < 2; ++j) {
        r[i + 2 * j] = __builtin_shufflevector(s[i + j], s[i + 2 + j], 0, 1, 8, 9, 4, 5, 12, 13);
        r[i + 2 * j + 1] = __builtin_shufflevector(s[i + j], s[i + 2 + j], 2, 3, 10, 11, 6, 7, 14, 15);
    }
    for (int j = 0; j < 4; ++j) {
        *(V8*)(to + j * ROW) = __builtin_shufflevector(r[j], r[4 + j], 0, 1, 2, 3, 8, 9, 10, 11);
        *(V8*)(to + (4 + j) * ROW) = __builtin_shufflevector(r[j], r[4 + j], 4, 5, 6, 7, 12, 13, 14, 15);
    }
};
"""


def fetch_code(channels: int, padded: int, column: int) -> str:
    """Return C++ of ``find(u, v, level, taps)`` and ``filter(taps, x)`` for a row of lanes of one texture.

    Args:
        channels: Channels that ``x`` [channels][ROW] receives.
        padded: Channels of a texel as stored.
        column: Where width, height and first texel stand in a record of the level table.
    """
    tile = f"float tile[ROW * {padded}]"
    moves = " ".join(
        f"transposed(tile + {r} * {padded} + {c}, {padded}, all + {c} * ROW + {r});"
        for c in range(0, padded, 8)
        for r in range(0, ROW, 8)
    )
    return f"""
auto find = [&](const float* u, const float* v, const int* level, Taps& to) {{
    alignas(32) int wide[ROW], high[ROW];
    for (int i = 0; i < ROW; ++i) {{
        const int* const rec = lv + 1 + {LEVEL} * level[i] + {column};
        wide[i] = rec[0]; high[i] = rec[1]; to.base[i] = rec[2];
    }}
    _Pragma("clang loop unroll(full)")
    for (int i = 0; i < ROW; i += 8) {{
        auto axis = [](const float* x, I8 size, I8& x0, I8& x1) __attribute__((always_inline)) {{
            V8 a = *(const V8*)x;
            a -= __builtin_elementwise_rint(a);  // -1/2 ... 1/2, exactly
            a = a == a ? a : (V8){{}};  // one that is no number: 0
            const V8 s = __builtin_convertvector(size, V8);
            V8 whole = __builtin_elementwise_floor(a * s - 0.5f);
            // The product, rounded, is as wrong as a texel is far from the middle; its remainder is not.
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
            V8 part = __builtin_elementwise_fma(a, s, -0.5f - whole);
#else
            V8 part = a * s - 0.5f - whole;
#endif
            whole = part < 0.0f ? whole - 1.0f : whole;  // where it was rounded up to a texel's centre
            part = part < 0.0f ? part + 1.0f : part;
            x0 = __builtin_convertvector(whole, I8);
            x0 = x0 < 0 ? x0 + size : x0;
            x1 = x0 + 1;
            x1 = x1 < size ? x1 : (I8){{}};
            return part;
        }};
        const I8 width = *(const I8*)(wide + i), height = *(const I8*)(high + i);
        I8 x0, x1, y0, y1;
        const V8 fx = axis(u + i, width, x0, x1), fy = axis(v + i, height, y0, y1), fxy = fx * fy;
        const I8 upper = y0 * width, lower = y1 * width;
        *(I8*)(to.at[0] + i) = upper + x0; *(I8*)(to.at[1] + i) = upper + x1;
        *(I8*)(to.at[2] + i) = lower + x0; *(I8*)(to.at[3] + i) = lower + x1;
        *(V8*)(to.w[0] + i) = 1.0f - fx - fy + fxy; *(V8*)(to.w[1] + i) = fx - fxy;
        *(V8*)(to.w[2] + i) = fy - fxy; *(V8*)(to.w[3] + i) = fxy;
    }}
    for (int i = 0; i < ROW; ++i) for (int k = 0; k < 4; k += 2)
        __builtin_prefetch(tx + 8ll * to.base[i] + {padded}ll * to.at[k][i]);
}};
auto filter = [&](const Taps& from, float* x) {{
    alignas(64) {tile}; alignas(64) float all[{padded} * ROW];
    for (int i = 0; i < ROW; ++i) {{
        const unsigned short* const first = tx + 8ll * from.base[i];
        V8 sum[{padded // 8}] = {{}};
        _Pragma("clang loop unroll(full)")
        for (int k = 0; k < 4; ++k) {{
            const unsigned short* const p = first + {padded}ll * from.at[k][i];
            const float part = from.w[k][i];
            _Pragma("clang loop unroll(full)")
            for (int c = 0; c < {padded // 8}; ++c) sum[c] += halves(p + 8 * c) * part;
        }}
        _Pragma("clang loop unroll(full)")
        for (int c = 0; c < {padded // 8}; ++c) *(V8*)(tile + i * {padded} + 8 * c) = sum[c];
    }}
    {moves}
    memcpy(x, all, {4 * channels} * ROW);
}};
"""


def table_code(layout, lanes: int) -> str:
    """Return C++ that names the parts of a block's scratch, ``own``."""
    text = []
    for name, (start, kind) in layout.parts(lanes).items():
        text.append(f"{kind}* const {name} = ({kind}*)(own.data + {start}); (void){name};")
    return "\n".join(text)
