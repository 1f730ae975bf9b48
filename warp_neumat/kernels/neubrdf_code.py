"""C++ of NeuBRDF's network for ``wp.func_native``: sums of codebook rows, the layers behind them, and the texture.

Rows (one lane's hidden units) lie contiguous, so a gathered codebook row feeds vector instructions as it is. The layers
of a few rows are multiplied at a time, with their sums in registers: each weight that is loaded serves all rows. Every
generator writes two forms of the same arithmetic: vector code by the width of the CPU's registers, and scalar code for
CUDA, where a block is one lane.

Names that the code reads (Warp arrays; see ``kernels/neubrdf.py`` for what they hold): ``index_0``, ``table_0``,
``index_1``, ``table_1``, ``place`` and ``corner`` [4 a side][L], ``base`` [L][H₁], ``weights``, ``active``, ``count``.
Only the first ``count`` lanes of ``active`` are touched.
"""


def by_width(write) -> str:
    """Return the code that ``write(floats of a register)`` gives, for the width that the compiler is told of."""
    return f"#if defined(__AVX512F__)\n{write(16)}\n#elif defined(__AVX__)\n{write(8)}\n#else\n{write(4)}\n#endif\n"


def _vector_type(vector: int) -> str:
    return (
        f"typedef float V __attribute__((vector_size({4 * vector}), aligned(4), may_alias)); enum {{ NV = {vector} }};"
        " const V Z = {};"
    )


def _total(vector: int) -> str:
    """C++ of ``total(s0, s1, s2)``, the sums over each register, side by side."""
    fold, width = [], vector
    while width > 4:
        width //= 2
        low, high = (", ".join(map(str, range(start, start + width))) for start in (0, width))
        fold.append((f"__builtin_shufflevector({{0}}, {{0}}, {low})", f"__builtin_shufflevector({{0}}, {{0}}, {high})"))
    text = ["typedef float Q __attribute__((vector_size(16)));"]
    text.append("auto total = [](V s0, V s1, V s2) __attribute__((always_inline)) -> Q {")
    for c in range(3):
        name = f"s{c}"
        for n, (low, high) in enumerate(fold):
            text.append(f"const auto s{c}_{n} = {low.format(name)} + {high.format(name)};")
            name = f"s{c}_{n}"
        text.append(f"const Q q{c} = {name};" if fold else f"const Q q{c} = (Q){name};")
    pair = "__builtin_shufflevector({0}, {1}, 0, 2, 4, 6) + __builtin_shufflevector({0}, {1}, 1, 3, 5, 7)"
    text.append(f"const Q a = {pair.format('q0', 'q1')}, b = {pair.format('q2', 'q2')};")
    text.append(f"return {pair.format('a', 'b')}; }};")
    return "\n".join(text)


def _pick(sides, width: int, lanes: int, uniform: bool) -> str:
    """C++ that points t[] at lane l's rows and c[] at their weights; ``sides`` are (table, first place)."""
    text = [f"const float* t[{4 * len(sides)}]; float c[{4 * len(sides)}];"]
    for n, (table, first) in enumerate(sides):
        text.append(
            f"for (int q = 0; q < 4; ++q) t[{4 * n} + q] ="
            f" table_{table}.data + {width} * (long long)index_{table}.data[place.data[({first} + q) * {lanes} + l]];"
        )
        if not uniform:
            text.append(f"for (int q = 0; q < 4; ++q) c[{4 * n} + q] = corner.data[({first} + q) * {lanes} + l];")
    return "\n".join(text)


def _sum(sides, uniform: bool) -> str:
    """C++ that adds the picked rows to v at unit j; uniform weights are in the tables."""
    weight = "" if uniform else " * c[q]"
    return f"for (int q = 0; q < {4 * len(sides)}; ++q) v += *(const V*)(t[q] + j){weight};"


def view_code(width: int, lanes: int, uniform: bool) -> str:
    """Return C++ that writes ``base``: the sum of side 1's rows, found at places 0 … 3."""
    sides = [(1, 0)]

    def write(vector):
        head = _vector_type(vector) if vector > 1 else "typedef float V; enum { NV = 1 }; const V Z = 0.0f;"
        return f"""{head}
for (int a = 0; a < count; ++a) {{
    const int l = active.data[a];
    {_pick(sides, width, lanes, uniform)}
    float* out = base.data + l * {width};
    for (int j = 0; j < {width}; j += NV) {{ V v = Z; {_sum(sides, uniform)} *(V*)(out + j) = v; }}
}}
"""

    return write(1) if lanes == 1 else by_width(write)


def network_code(rows: tuple[int, ...], lanes: int, *, both: bool, based: bool, uniform: bool) -> str:
    """Return C++ that writes the network's outputs ``y`` [3][L].

    Args:
        rows: Padded hidden widths.
        lanes: Lanes of a block.
        both: Whether side 1's rows are summed here, from places 4 … 7, or are in ``base`` already.
        based: Whether the sums start from ``base``.
        uniform: Whether all corners weigh the same; their weight is in the tables.
    """
    sides = [(1, 4), (0, 0)] if both else [(0, 0)]
    if lanes == 1:
        return _scalar_network(rows, sides, based, uniform)
    # Rows and registers of sums at a time: twelve sums hide the latency of a multiply-add and leave room for operands.
    blocks = {16: (8, 1), 8: (6, 2), 4: (4, 2)}
    return by_width(lambda vector: _vector_network(rows, lanes, sides, based, uniform, vector, *blocks[vector]))


def _vector_network(hidden, lanes, sides, based, uniform, nv: int, rows: int, vectors: int) -> str:
    first = hidden[0]
    start = f"*(const V*)(base.data + l * {first} + j)" if based else "Z"
    each, lines = 4 * len(sides), first // 16  # rows of the tables that a lane sums, and cache lines of one
    # Steps of the first multiplication: in each a line of the next lanes' rows is asked for, which otherwise would have
    # to come from the second-level cache while nothing else can be done.
    steps = hidden[1] // (nv * vectors) * first if len(hidden) > 1 else 0
    text = [
        _vector_type(nv),
        _total(nv),
        f"alignas(64) float h0[{rows * max(hidden)}]; alignas(64) float h1[{rows * max(hidden)}];",
        f"int lane[{rows}], after[{rows}]; const float* t[{max(rows * each, -(-steps // lines))}];",
        "for (const float*& p : t) p = table_0.data;",
        # The last group repeats its last lane: the same values are written twice.
        f"auto find = [&](int a) {{ for (int r = 0; r < {rows}; ++r) {{",
        "const int l = active.data[a + r < count ? a + r : count - 1]; after[r] = l;",
    ]
    for n, (table, place) in enumerate(sides):
        text.append(
            f"for (int q = 0; q < 4; ++q) t[{each} * r + {4 * n} + q] ="
            f" table_{table}.data + {first} * (long long)index_{table}.data[place.data[({place} + q) * {lanes} + l]];"
        )
    text += [
        "} }; find(0);",
        f"for (int a = 0; a < count; a += {rows}) {{",
        f"for (int r = 0; r < {rows}; ++r) {{",
        f"const int l = lane[r] = after[r]; const float* const* p = t + {each} * r;",
    ]
    if not uniform:
        text.append(f"float c[{each}];")
        for n, (_, place) in enumerate(sides):
            text.append(f"for (int q = 0; q < 4; ++q) c[{4 * n} + q] = corner.data[({place} + q) * {lanes} + l];")
    weight = "" if uniform else " * c[q]"
    text += [
        f"for (int j = 0; j < {first}; j += NV) {{ V v = {start};",
        f"for (int q = 0; q < {each}; ++q) v += *(const V*)(p[q] + j){weight};",
        f"*(V*)(h0 + r * {first} + j) = v > 0.0f ? v : Z; }} }}",
        f"if (a + {rows} < count) find(a + {rows});",
        "int e = 0;" if steps else "",
    ]
    source, offset, width = 0, 0, first
    for out in hidden[1:]:
        text.append(f"for (int o = 0; o < {out}; o += {nv * vectors}) {{")
        text.append(f"const float* w = weights.data + {offset + out} + o;")
        cells = [(r, u) for r in range(rows) for u in range(vectors)]
        text += [f"V a{r}_{u} = *(const V*)(weights.data + {offset} + o + {u} * NV);" for r, u in cells]
        text.append('_Pragma("clang loop unroll_count(4)")')
        text.append(f"for (int k = 0; k < {width}; ++k, w += {out}) {{")
        if source == 0 and offset == 0:
            text.append(f"__builtin_prefetch(t[e / {lines}] + 16 * (e % {lines})); ++e;")
        text += [f"const V w{u} = *(const V*)(w + {u} * NV);" for u in range(vectors)]
        for r in range(rows):
            adds = "".join(f" a{r}_{u} += w{u} * s;" for u in range(vectors))
            text.append(f"{{ const float s = h{source}[{r * width} + k];{adds} }}")
        text.append("}")
        text += [f"*(V*)(h{1 - source} + {r * out} + o + {u} * NV) = a{r}_{u} > 0.0f ? a{r}_{u} : Z;" for r, u in cells]
        text.append("}")
        offset += out + width * out
        source, width = 1 - source, out
    text.append(f"const float* wl = weights.data + {offset + 3};")
    text.append(
        f"for (int r = 0; r < {rows}; ++r) {{ V s0 = Z, s1 = Z, s2 = Z; const float* h = h{source} + r * {width};"
    )
    text.append(f"for (int j = 0; j < {width}; j += NV) {{ const V v = *(const V*)(h + j);")
    text += [f"s{c} += v * *(const V*)(wl + {c * width} + j);" for c in range(3)]
    text.append("}")
    text.append("const Q f = total(s0, s1, s2);")
    text += [f"y.data[{c * lanes} + lane[r]] = f[{c}] + weights.data[{offset + c}];" for c in range(3)]
    text.append("} }")
    return "\n".join(text)


def _scalar_network(hidden, sides, based, uniform) -> str:
    first, widest = hidden[0], max(hidden)
    text = [
        f"typedef float V; float h0[{widest}]; float h1[{widest}]; const int l = 0;",
        _pick(sides, first, 1, uniform),
        f"for (int j = 0; j < {first}; ++j) {{ float v = {'base.data[j]' if based else '0.0f'}; {_sum(sides, uniform)}"
        " h0[j] = v > 0.0f ? v : 0.0f; }",
    ]
    source, offset, width = 0, 0, first
    for out in hidden[1:]:
        text.append(
            f"for (int o = 0; o < {out}; ++o) {{ float v = weights.data[{offset} + o];"
            f" for (int k = 0; k < {width}; ++k) v += weights.data[{offset + out} + k * {out} + o] * h{source}[k];"
            f" h{1 - source}[o] = v > 0.0f ? v : 0.0f; }}"
        )
        offset += out + width * out
        source, width = 1 - source, out
    text.append(
        f"for (int c = 0; c < 3; ++c) {{ float v = weights.data[{offset} + c];"
        f" for (int k = 0; k < {width}; ++k) v += weights.data[{offset + 3} + c * {width} + k] * h{source}[k];"
        " y.data[c] = v; }"
    )
    return "\n".join(text)


# ---- texture ---------------------------------------------------------------------------------------------------------

_TAPS = """
auto wrapped = [](float a) -> float { a -= floorf(a); return a >= 0.0f ? a : 0.0f; };  // one that is no number: 0
auto taps = [](float a, int size, int& a0, int& a1) -> float {
    const float p = a * (float)size - 0.5f, whole = floorf(p);
    a0 = (int)whole; a1 = a0 + 1;
    a0 = a0 < 0 ? size - 1 : a0; a1 = a1 < size ? a1 : 0;
    return p - whole;
};
"""

_HALF_BITS = """
auto value = [](unsigned short bits) -> float {
    // Shifted into place, a half is a float 2^112 too small, denormal ones included.
    const unsigned wide = (bits & 0x7FFFu) << 13;
    float size; memcpy(&size, &wide, 4);
    size *= 5.192296858534828e33f;
    return bits & 0x8000u ? -size : size;
};
"""

_HALF_ADD = {
    True: """
typedef _Float16 H8 __attribute__((vector_size(16), aligned(2), may_alias));
typedef float V8 __attribute__((vector_size(32), aligned(4), may_alias));
auto add = [](const unsigned short* p, float w, float* f) {
    for (int c = 0; c < CHANNELS; c += 8) *(V8*)(f + c) += __builtin_convertvector(*(const H8*)(p + c), V8) * w;
};
""",
    False: _HALF_BITS
    + """
auto add = [&](const unsigned short* p, float w, float* f) {
    for (int c = 0; c < CHANNELS; ++c) f[c] += value(p[c]) * w;
};
""",
}


def texture_code(width: int, channels: int, lanes: int, *, add: bool) -> str:
    """Return C++ that brings a texture's share of the first layer into ``base``.

    It reads ``at`` [3][L] (u, v, mip level), ``levels`` (mips, then width, height and first texel of each), ``texels``
    (bits of float16, ``channels`` a texel) and ``texel_weights`` [channels][H₁].

    Args:
        width: Padded width H₁ of the first layer.
        channels: Channels of a texel as stored, a multiple of 8.
        lanes: Lanes of a block.
        add: Whether to add to what ``base`` holds, or to overwrite it.
    """
    start = "out[j]" if add else "0.0f"

    def write(simd):
        return (
            _TAPS
            + _HALF_ADD[simd].replace("CHANNELS", str(channels))
            + f"""
const int top = levels.data[0] - 1;
for (int n = 0; n < count; ++n) {{
    const int l = active.data[n];
    const float a = wrapped(at.data[l]), b = wrapped(at.data[{lanes} + l]);
    float s = at.data[{2 * lanes} + l];
    if (!(s > 0.0f)) s = 0.0f;
    if (!(s < (float)top)) s = (float)top;
    const int m = (int)s;
    const float part = s - (float)m;
    alignas(32) float f[{channels}] = {{}};
    for (int side = 0; side < (part > 0.0f ? 2 : 1); ++side) {{
        const int* rec = levels.data + 1 + 3 * (m + side);
        int x0, x1, y0, y1;
        const float fx = taps(a, rec[0], x0, x1), fy = taps(b, rec[1], y0, y1);
        const unsigned short* first = texels.data + {channels}ll * rec[2];
        const unsigned short* upper = first + {channels}ll * y0 * rec[0];
        const unsigned short* lower = first + {channels}ll * y1 * rec[0];
        const float share = side ? part : 1.0f - part, below = fy * share, above = share - below;
        add(upper + {channels} * x0, above - above * fx, f); add(upper + {channels} * x1, above * fx, f);
        add(lower + {channels} * x0, below - below * fx, f); add(lower + {channels} * x1, below * fx, f);
    }}
    float* out = base.data + l * {width};
    for (int o = 0; o < {width}; o += 16) {{
        float v[16];
        for (int j = o; j < o + 16; ++j) v[j - o] = {start};
        for (int c = 0; c < {channels}; ++c)
            for (int j = 0; j < 16; ++j) v[j] += f[c] * texel_weights.data[c * {width} + o + j];
        for (int j = 0; j < 16; ++j) out[o + j] = v[j];
    }}
}}
"""
        )

    if lanes == 1:
        return write(False)
    return f"#if defined(__AVX__) && defined(__F16C__)\n{write(True)}\n#else\n{write(False)}\n#endif\n"
