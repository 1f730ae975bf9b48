"""C++ for products of matrices whose rows are samples: the layers of a network and their backward, on the CPU.

Rows (one sample's units) lie contiguous, so that layers, transposed products and gradients of weights are all one
register-blocked matrix product, and gathered rows need no transposing. Widths are multiples of 8 float32, one AVX
register. For use in ``wp.func_native`` snippets; :data:`VECTORS` comes first in the snippet.
"""

VECTORS = """
typedef float V __attribute__((vector_size(32), aligned(4), may_alias));
typedef int I8 __attribute__((vector_size(32), aligned(4), may_alias));
const V Z = {};
auto sum8 = [](V s) { return ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7])); };
auto pairs = [](V a, V b) { return __builtin_shufflevector(a, b, 0, 8, 2, 10, 4, 12, 6, 14)
    + __builtin_shufflevector(a, b, 1, 9, 3, 11, 5, 13, 7, 15); };
auto fours = [](V a, V b) { return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13)
    + __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15); };
auto sums8 = [=](V a, V b, V c, V d, V e, V f, V g, V h) {
    const V s = fours(pairs(a, b), pairs(c, d)), t = fours(pairs(e, f), pairs(g, h));
    return (V)(__builtin_shufflevector(s, t, 0, 1, 2, 3, 8, 9, 10, 11)
        + __builtin_shufflevector(s, t, 4, 5, 6, 7, 12, 13, 14, 15)); };
auto clamped = [](V x) { return __builtin_elementwise_min(__builtin_elementwise_max(x, V{}), V{} + 1.0f); };
auto select = [](I8 m, V a, V b) { return (V)(((I8)a & m) | ((I8)b & ~m)); };
"""
"""Types V and I8 of 8 lanes, zero Z, sum8(v), sums8 of eight of them, clamped(v) to [0, 1], select(mask, a, b)."""

EXPONENTIAL = """
auto larger = [](V a, V b) { return a > b ? a : b; };
auto smaller = [](V a, V b) { return a < b ? a : b; };
auto exponential_parts = [=](V x, const float s, V& power) {
    x = larger(V{} - 69.0f, x);
    // 1.5 * 2^23 and the bias of exponents: what is left of the mantissa is n + 127.
    const V whole = x * 1.4426950408889634f + 12583039.0f;
    const V f = x * 1.4426950408889634f - (whole - 12583039.0f);
    V p = f * (s * 1.326470879e-3f) + s * 9.671511471e-3f; p = p * f + s * 5.550733776e-2f;
    p = p * f + s * 2.402224210e-1f; p = p * f + s * 6.931469776e-1f; p = p * f + s;
    power = (V)((I8)whole << 23);
    return p;
};
auto exponential = [=](V x) { V power; const V p = exponential_parts(x, 1.0f, power); return p * power; };
"""
"""larger(a, b) and smaller(a, b), one instruction each, which give b where either is NaN; and exponential(v), e^x for x
up to 87 and e^-69 below -69: 2^n times a polynomial for 2^f on [-1/2, 1/2] (degree 5, by Lawson's iteration, 9.2e-8),
3e-7 relative with rounding. exponential_parts(v, s, power) returns the polynomial times a constant s and gives 2^n, so
that s e^x + a is one instruction more."""


def padded(width: int) -> int:
    """Return ``width`` rounded up to whole registers of 8 float32."""
    return -(-width // 8) * 8


def product(
    *,
    a,
    row,
    step,
    rows,
    depth,
    b,
    stride,
    columns,
    out,
    width,
    start="Z",
    mask=None,
    relu=False,
    add=False,
    hardswish=None,
    slope=None,
    slope_of=None,
    apply=None,
    few=0,
) -> str:
    """C++ of out[r][o] = start + Σ_k a[r·row + k·step] · b[k·stride + o], 4 rows by 24 or 16 columns at a time.

    ``rows`` and ``columns`` are multiples of 8. ``start`` is the name of a row to start from, ``mask`` of a matrix like
    ``out``: 0 is written where it is not above 0. ``hardswish`` is where the slopes of that activation go, a matrix
    like ``out``; ``slope`` one that the result is multiplied with, or with what the function ``slope_of`` makes of it.
    ``apply`` is a function of registers that the result goes through. If ``few``, how many of the last 8 columns count,
    is 1 or 2, they are dot products along k instead of sums of whole registers, and the rest of the 8 is left as it is:
    for a step of 1, a start, an apply and nothing else, where rows of a are finite up to a depth of a multiple of 8.
    """

    def tile(vectors: int, tall: int, begin: int, end: int) -> str:
        cells = [(r, u) for r in range(tall) for u in range(vectors)]
        text = [f"for (int r = 0; r < {rows}; r += {tall})"]
        text.append(f"for (int o = {begin}; o < {end}; o += {8 * vectors}) {{")
        for r, u in cells:
            value = "Z" if start == "Z" else f"*(const V*)({start} + o + {8 * u})"
            text.append(f"V s{r}_{u} = {value};")
        text.append(f"const float* p = {a} + r * {row}; const float* q = {b} + o;")
        text.append('_Pragma("clang loop unroll_count(4)")')
        text.append(f"for (int k = 0; k < {depth}; ++k, p += {step}, q += {stride}) {{")
        text += [f"const V q{u} = *(const V*)(q + {8 * u});" for u in range(vectors)]
        for r in range(tall):
            sums = "".join(f" s{r}_{u} += q{u} * x;" for u in range(vectors))
            text.append(f"{{ const float x = p[{r} * {row}];{sums} }}")
        text.append("}")
        for r, u in cells:
            place = f"({out} + (r + {r}) * {width} + o + {8 * u})"
            value = f"s{r}_{u}"
            if relu:
                value = f"select({value} > 0.0f, {value}, Z)"
            cell = f"(r + {r}) * {width} + o + {8 * u}"
            if hardswish:
                text.append(f"{{ const V s = {value}, t = clamped(s * 0.16666667f + 0.5f);")
                text.append(f"*(V*)({hardswish} + {cell}) = select((t > 0.0f) & (t < 1.0f), 2.0f * t - 0.5f, t);")
                text.append(f"{value} = s * t; }}")
            if slope:
                value = f"{value} * {slope_of or ''}(*(const V*)({slope} + {cell}))"
            if apply:
                value = f"{apply}({value})"
            if mask:
                value = f"select(*(const V*)({mask} + (r + {r}) * {width} + o + {8 * u}) > 0.0f, {value}, Z)"
            text.append(f"*(V*){place} {'+=' if add else '='} {value};")
        text.append("}")
        return "\n".join(text)

    def dots(begin: int) -> str:
        text = []
        for o in range(begin, begin + few):
            text.append(f"{{ float column[{padded(depth)}];")
            text.append(f"for (int k = 0; k < {depth}; ++k) column[k] = {b}[k * {stride} + {o}];")
            if depth < padded(depth):
                text.append(f"for (int k = {depth}; k < {padded(depth)}; ++k) column[k] = 0.0f;")
            text.append(f"for (int r = 0; r < {rows}; r += 8) {{ const float* const p = {a} + r * {row};")
            text.append("V " + ", ".join(f"s{r} = Z" for r in range(8)) + ";")
            text.append(f"for (int k = 0; k < {padded(depth)}; k += 8) {{ const V q = *(const V*)(column + k);")
            text += [f"s{r} += *(const V*)(p + {r * row} + k) * q;" for r in range(8)]
            text.append("}")
            text.append(f"const V t = {apply}(sums8(s0, s1, s2, s3, s4, s5, s6, s7) + {start}[{o}]);")
            text.append(f"for (int j = 0; j < 8; ++j) {out}[(r + j) * {width} + {o}] = t[j]; }} }}")
        return "\n".join(text)

    if few in (1, 2):
        columns -= 8
    # Tiles of 4 by 24 load least; of 4 by 16 next; one of 8 columns is as tall as keeps 8 sums going.
    vectors = columns // 8
    threes = vectors // 3 - (vectors % 3 == 1 and vectors > 1)
    wide, whole = 24 * threes, columns // 8 * 8 - 8 * ((vectors - 3 * threes) % 2)
    tiles = [
        tile(vectors, tall, begin, end)
        for vectors, tall, begin, end in ((3, 4, 0, wide), (2, 4, wide, whole), (1, 8, whole, columns))
        if end > begin
    ]
    return "\n".join([*tiles, dots(columns)] if few in (1, 2) else tiles)
