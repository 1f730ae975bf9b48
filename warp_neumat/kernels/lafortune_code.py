"""C++ of the Lafortune fit: eight texels in the lanes of a vector, one pass over the pairs for each normal equation.

With p_j = (ω_oᵀ M_j ω_i)^n_j and P the nine products of ω_o and ω_i, a residual's derivative by M_j is ρ_j b_j P with
b_j = n_j p_j / (ω_oᵀ M_j ω_i), and by ln n_j it is ρ_j l_j with l_j = n_j p_j ln(ω_oᵀ M_j ω_i). So every entry of JᵀJ
is a product of colours with one of the sums over pairs

- Σ b_j b_k P Pᵀ, where P Pᵀ has 36 different entries that no texel depends on (10 × 36 sums);
- Σ b_j (p_k, l_k, e_j) P, e_j = Σ_c ρ_jc r_c (40 × 9 sums), p_0 the diffuse term;
- Σ of products of p and l (64 sums),

matrix products in registers, 784 multiply-adds a pair instead of the 3 × 1540 of the dense Jacobian.
"""

LANES = 8
"""Texels that one thread fits at once."""
LOBES = 4
COLUMNS = LOBES + 1
"""Terms with a colour: diffuse, then the lobes."""
UNKNOWNS = 3 * COLUMNS + 10 * LOBES
"""Order in the normal equations: colours [channel][column], then for each lobe M (9, row-major) and ln n."""
LOSS, DAMPING, STALLED, STEPS, SCALE = range(UNKNOWNS, UNKNOWNS + 5)
STATE = UNKNOWNS + 5
"""Numbers of a texel's state: the unknowns in units of the texel's mean, loss, damping, small steps in a row, steps
taken, and the mean."""
CHUNK = 32
"""Pairs whose weights stay in first-level cache between the passes of the matrix products."""
STALL = 3
"""Small steps in a row after which a texel has converged."""
HARDEST = 1e7
"""Damping at which a texel is given up as converged."""
EXACT = 1e-13
"""Loss, in units of the squared mean, at which nothing is left to gain in float32."""
LEAST_N, MOST_N = 0.5, 200.0
SMALLEST = 1e-12
"""Bases of a power below this count as 0."""
FLATTEST = 1e-3
"""Smallest base that b_j divides by: below 1 an exponent's slope at 0 has no bound."""

_ROW = 56
# Floats of scratch: for a pair data (3), weight (1), powers (4); then the sums, the matrix and the weights of a chunk.
_PAIR_WORDS = 8 * LANES
_SUMS = 360 + 360 + 64
_FIXED_WORDS = LANES * (_SUMS + CHUNK * (10 + 40 + 24) + 60 * _ROW + 8 * 64)


def scratch_words(padded: int) -> int:
    """Return the float32 words of scratch that a worker needs for ``padded`` pairs."""
    return padded * _PAIR_WORDS + _FIXED_WORDS + 64


def _sums(entries, into: str, most: int = 10) -> str:
    """C++ that adds Σ_k left·right over a chunk to ``into[index]`` for entries (index, left, right) of pair k."""
    text = []
    for first in range(0, len(entries), most):
        part = entries[first : first + most]
        text += [f"{{ V s{n} = Z;" if n == 0 else f"V s{n} = Z;" for n in range(len(part))]
        text.append(f"for (int k = 0; k < {CHUNK}; ++k) {{")
        text += [f"s{n} += {left} * {right};" for n, (_, left, right) in enumerate(part)]
        text.append("}")
        text += [f"{into}[{index}] += s{n};" for n, (index, _, _) in enumerate(part)]
        text.append("}")
    return "\n".join(text)


def _product(*, tiles: int, rows: int, columns: int, wide: int, weights: str, table: str, into: str) -> str:
    """C++ of ``into[row][column] += Σ_k weights[tile][k][row] · table[k][column]`` with ``wide`` columns at a time."""
    cells = [(r, c) for r in range(rows) for c in range(wide)]
    text = [f"for (int t = 0; t < {tiles}; ++t) for (int c = 0; c < {columns}; c += {wide}) {{"]
    text.append(f"V* const out = {into} + t * {rows * columns} + c;")
    text += [f"V s{r}_{c} = out[{r * columns + c}];" for r, c in cells]
    text.append(f"const V* w = {weights} + t * {rows * CHUNK}; const float* q = {table} + c;")
    text.append(f"for (int k = 0; k < {CHUNK}; ++k, w += {rows}, q += {columns}) {{")
    text += [f"const V w{r} = w[{r}];" for r in range(rows)]
    for c in range(wide):
        text.append(f"{{ const float x = q[{c}];" + "".join(f" s{r}_{c} += w{r} * x;" for r in range(rows)) + " }")
    text.append("}")
    text += [f"out[{r * columns + c}] = s{r}_{c};" for r, c in cells]
    text.append("}")
    return "\n".join(text)


HEAD = f"""
typedef float V __attribute__((vector_size(32), aligned(4), may_alias));
typedef int I8 __attribute__((vector_size(32), aligned(4), may_alias));
typedef double D __attribute__((vector_size(64), aligned(8)));
typedef long long L8 __attribute__((vector_size(64), aligned(8)));
const V Z = {{}};
auto select = [](I8 m, V a, V b) {{ return (V)(((I8)a & m) | ((I8)b & ~m)); }};
auto choose = [](L8 m, D a, D b) {{ return (D)(((L8)a & m) | ((L8)b & ~m)); }};
auto most = [](V a, V b) {{ return a > b ? a : b; }};
auto least = [](V a, V b) {{ return a < b ? a : b; }};
auto root = [](V x) {{ return __builtin_elementwise_sqrt(x); }};
auto wide = [](V x) {{ return __builtin_convertvector(x, D); }};
auto narrow = [](D x) {{ return __builtin_convertvector(x, V); }};
auto any = [](I8 m) {{ int s = 0; for (int i = 0; i < {LANES}; ++i) s |= m[i]; return s != 0; }};
// e^x, x clamped to [-80, 80]: 2^n times the minimax polynomial of kernels/approx.py.
auto exponential = [&](V x) {{
    const V t = least(most(x * 1.4426950408889634f, Z - 115.0f), Z + 115.0f);
    const I8 n = __builtin_convertvector(t + 1024.5f, I8) - 1024;
    const V f = t - __builtin_convertvector(n, V);
    V p = f * 1.534581182e-4f + 1.339993122e-3f; p = p * f + 9.618488958e-3f; p = p * f + 5.550328777e-2f;
    p = p * f + 2.402264689e-1f; p = p * f + 6.931472057e-1f; p = p * f + 1.0f;
    return p * (V)((n + 127) << 23);
}};
// log x for positive normal x: exponent, and 2 atanh(s) of the mantissa.
auto logarithm = [](V x) {{
    const I8 bits = (I8)x, n = (bits - 0x3f3504f3) >> 23;
    const V m = (V)(bits - (n << 23)), s = (m - 1.0f) / (m + 1.0f), z = s * s;
    V p = z * 0.1111111111f + 0.1428571429f; p = p * z + 0.2f; p = p * z + 0.3333333333f;
    p = 2.0f * s + 2.0f * s * z * p;
    return p + __builtin_convertvector(n, V) * 0.6931471806f;
}};
// The base q of a lobe (M, ln n) under a pair's nine products, its logarithm and its power; 0 where q is not positive.
auto lobe = [&](const V* m, V exponent, const float* P, V& q, V& lg) {{
    q = m[0] * P[0]; for (int i = 1; i < 9; ++i) q += m[i] * P[i];
    const I8 lit = q > {SMALLEST}f;
    lg = select(lit, logarithm(select(lit, q, Z + 1.0f)), Z);
    return select(lit, exponential(exponent * lg), Z);
}};
"""

# G_ij = Σ w p_i p_j and B_ic = Σ w p_i y_c, index 0 … 14 and 15 … 29. PP holds p_1 … p_4 of a pair, Y its data.
_PAIRS_OF_COLUMNS = [(i, j) for i in range(COLUMNS) for j in range(i + 1)]
_COLOUR_SUMS = "\n".join(
    _sums(
        [(n, f"wp[{CHUNK * i} + k]", f"cp[{CHUNK * j} + k]") for n, (i, j) in enumerate(_PAIRS_OF_COLUMNS) if i == row]
        + [(15 + 3 * row + c, f"wp[{CHUNK * row} + k]", f"y[3 * k + {c}]") for c in range(3)],
        "sum",
    )
    for row in range(COLUMNS)
)

_COLOURS = f"""
auto powers = [&](const V* th) {{  // p_1 … p_4 of every pair into PP
    V n[{LOBES}], q, lg;
    for (int j = 0; j < {LOBES}; ++j) n[j] = exponential(th[10 * j + 9]);
    for (int k = 0; k < padded; ++k) for (int j = 0; j < {LOBES}; ++j)
        PP[4 * k + j] = lobe(th + 10 * j, n[j], outer + 9 * k, q, lg) * lobe_scale[k];
}};
// The colours ≥ 0 that minimise Σ w |y − Σ_j col_j p_j|² + ridge Σ col²: the best of the 32 sets of columns that may
// differ from 0, each solved by Cholesky; the whole set first, because it usually is the one.
auto colours = [&](V* col) {{
    D G[15] = {{}}, B[15] = {{}};
    V* const wp = buffer; V* const cp = buffer + {COLUMNS * CHUNK};
    for (int first = 0; first < padded; first += {CHUNK}) {{
        V sum[30]; for (int i = 0; i < 30; ++i) sum[i] = Z;
        const V* const y = Y + 3 * first;
        for (int k = 0; k < {CHUNK}; ++k) {{
            const V w = WT[first + k];
            cp[k] = Z + diffuse_scale[first + k]; wp[k] = w * cp[k];
            for (int j = 0; j < {LOBES}; ++j) {{
                const V p = PP[4 * (first + k) + j];
                cp[{CHUNK} * (j + 1) + k] = p; wp[{CHUNK} * (j + 1) + k] = w * p;
            }}
        }}
        {_COLOUR_SUMS}
        for (int i = 0; i < 15; ++i) {{ G[i] += wide(sum[i]); B[i] += wide(sum[15 + i]); }}
    }}
    for (int j = 0; j < {COLUMNS}; ++j) G[j * (j + 1) / 2 + j] += (double)ridge;
    D best[3], kept[15]; const D zero = {{}};
    for (int c = 0; c < 3; ++c) best[c] = zero;
    for (int i = 0; i < 15; ++i) kept[i] = zero;
    for (int set = {2**COLUMNS - 1}; set > 0; --set) {{
        D C[15], inverse[{COLUMNS}];
        for (int i = 0; i < {COLUMNS}; ++i) for (int j = 0; j <= i; ++j) {{
            const bool in = (set >> i & 1) && (set >> j & 1);
            D s = in ? G[i * (i + 1) / 2 + j] : zero + (i == j ? 1.0 : 0.0);
            for (int k = 0; k < j; ++k) s -= C[i * (i + 1) / 2 + k] * C[j * (j + 1) / 2 + k];
            if (i == j) {{
                const D floor = 1e-12 * G[i * (i + 1) / 2 + i] + 1e-30;
                s = choose(s > floor, s, floor);
                inverse[i] = 1.0 / __builtin_elementwise_sqrt(s);
                C[i * (i + 1) / 2 + i] = s * inverse[i];
            }} else C[i * (i + 1) / 2 + j] = s * inverse[j];
        }}
        L8 whole = (L8){{}} - 1;
        for (int c = 0; c < 3; ++c) {{
            D x[{COLUMNS}], gain = zero; L8 good = (L8){{}} - 1;
            for (int i = 0; i < {COLUMNS}; ++i) {{
                D s = (set >> i & 1) ? B[3 * i + c] : zero;
                for (int k = 0; k < i; ++k) s -= C[i * (i + 1) / 2 + k] * x[k];
                x[i] = s * inverse[i]; gain += x[i] * x[i];
            }}
            for (int i = {COLUMNS - 1}; i >= 0; --i) {{
                D s = x[i];
                for (int k = i + 1; k < {COLUMNS}; ++k) s -= C[k * (k + 1) / 2 + i] * x[k];
                x[i] = s * inverse[i]; good &= x[i] >= 0.0;
            }}
            whole &= good; good &= gain > best[c];
            best[c] = choose(good, gain, best[c]);
            for (int i = 0; i < {COLUMNS}; ++i) kept[{COLUMNS} * c + i] = choose(good, x[i], kept[{COLUMNS} * c + i]);
        }}
        if (set == {2**COLUMNS - 1}) {{
            long long all = -1; for (int l = 0; l < {LANES}; ++l) all &= whole[l];
            if (all) break;
        }}
    }}
    for (int i = 0; i < 15; ++i) col[i] = narrow(kept[i]);
}};
auto loss_of = [&](const V* col) {{
    D total = {{}};
    for (int first = 0; first < padded; first += {CHUNK}) {{
        V sum = Z;
        for (int k = first; k < first + {CHUNK}; ++k) {{
            V s = Z;
            for (int c = 0; c < 3; ++c) {{
                V r = Y[3 * k + c] - col[{COLUMNS} * c] * diffuse_scale[k];
                for (int j = 0; j < {LOBES}; ++j) r -= col[{COLUMNS} * c + 1 + j] * PP[4 * k + j];
                s += r * r;
            }}
            // sqrt(s + ε²) − ε without cancellation
            sum += softness > 0.0f ? 2.0f * s / (root(s + softness * softness) + softness) : s;
        }}
        total += wide(sum);
    }}
    V size = Z; for (int i = 0; i < 15; ++i) size += col[i] * col[i];
    return narrow((total + wide(size * ridge)) / (double)pairs);
}};
// M in units of its largest base over lights and the hemisphere of views: p is at most 1 and a colour is its peak.
auto gauge = [&](V* th) {{
    for (int j = 0; j < {LOBES}; ++j) {{
        V* const m = th + 10 * j; V top = Z, size = Z;
        for (int g = 0; g < gauges; ++g) {{
            const float* const d = gauge_lights + 3 * g;
            const V x = m[0] * d[0] + m[1] * d[1] + m[2] * d[2], y = m[3] * d[0] + m[4] * d[1] + m[5] * d[2];
            const V z = most(m[6] * d[0] + m[7] * d[1] + m[8] * d[2], Z);
            top = most(top, x * x + y * y + z * z);
        }}
        for (int i = 0; i < 9; ++i) size += m[i] * m[i];
        top = 1.0f / root(most(most(top, size * 1e-4f), Z + 1e-20f));
        for (int i = 0; i < 9; ++i) m[i] *= top;
    }}
}};
"""

_TRIANGLE = [(j, k) for j in range(LOBES) for k in range(j + 1)]
_GRAM_ROWS = [f"c{j}" for j in range(COLUMNS)] + [f"l{j}" for j in range(LOBES)]


def _row(n: int) -> str:
    """C++ of row ``n`` of a chunk's rows: w p_j (5), w l_j (4), p_j (5), l_j (4), w r_c (3), e_j (4)."""
    return f"rows[{CHUNK * n} + k]"


# Sums of products of p and l: lower triangle of 9 (45), then Σ w p_j r_c (15), then Σ l_j e_j (4).
_SMALL = (
    [(n * (n + 1) // 2 + m, _row(n), _row(9 + m)) for n in range(9) for m in range(n + 1)]
    + [(45 + 3 * j + c, _row(9 + j), _row(18 + c)) for j in range(COLUMNS) for c in range(3)]
    + [(60 + j, _row(14 + j), _row(21 + j)) for j in range(LOBES)]
)

_GRAM = f"""
auto gram = [&](const V* th, const V* col) {{  // all sums, and the weights of the next colours
    for (int i = 0; i < {_SUMS}; ++i) SU[i] = Z;
    V* const AB = SU; V* const AP = SU + 360; V* const AS = SU + 720;
    V* const W1 = buffer; V* const W2 = buffer + {10 * CHUNK}; V* const rows = buffer + {50 * CHUNK};
    V n[{LOBES}];
    for (int j = 0; j < {LOBES}; ++j) n[j] = exponential(th[10 * j + 9]);
    for (int first = 0; first < padded; first += {CHUNK}) {{
        for (int k = 0; k < {CHUNK}; ++k) {{
            V b[{LOBES}], x[9], r[3]; const int at = first + k;
            x[0] = Z + diffuse_scale[at];
            for (int j = 0; j < {LOBES}; ++j) {{
                V q, lg;
                const V p = lobe(th + 10 * j, n[j], outer + 9 * at, q, lg) * lobe_scale[at];
                x[1 + j] = p; x[5 + j] = n[j] * p * lg; b[j] = n[j] * p / most(q, Z + {FLATTEST}f);
            }}
            V s = Z;
            for (int c = 0; c < 3; ++c) {{
                r[c] = Y[3 * at + c];
                for (int j = 0; j < {COLUMNS}; ++j) r[c] -= col[{COLUMNS} * c + j] * x[j];
                s += r[c] * r[c];
            }}
            const V w = at < pairs ? softness > 0.0f ? 1.0f / root(s + softness * softness) : Z + 1.0f : Z;
            WT[at] = w;
            for (int i = 0; i < 9; ++i) {{ rows[{CHUNK} * i + k] = w * x[i]; rows[{CHUNK} * (9 + i) + k] = x[i]; }}
            for (int c = 0; c < 3; ++c) {{ r[c] *= w; rows[{CHUNK} * (18 + c) + k] = r[c]; }}
            for (int j = 0; j < {LOBES}; ++j) {{
                V e = Z; for (int c = 0; c < 3; ++c) e += col[{COLUMNS} * c + 1 + j] * r[c];
                rows[{CHUNK} * (21 + j) + k] = e;
                const V wb = w * b[j];
                V* const to = W2 + {10 * CHUNK} * j + 10 * k;
                for (int i = 0; i < 9; ++i) to[i] = wb * x[i];
                to[9] = b[j] * e;
                for (int i = 0; i <= j; ++i) {{
                    const int row = j * (j + 1) / 2 + i;
                    W1[row / 5 * {5 * CHUNK} + 5 * k + row % 5] = wb * b[i];
                }}
            }}
        }}
        const float* const Q = squares + 36 * first; const float* const P = outer + 9 * first;
        {_product(tiles=2, rows=5, columns=36, wide=2, weights="W1", table="Q", into="AB")}
        {_product(tiles=4, rows=10, columns=9, wide=1, weights="W2", table="P", into="AP")}
        {_sums(_SMALL, "AS")}
    }}
}};
// JᵀJ's lower triangle into H[row][column] and Jᵀr into gradient.
auto assemble = [&](const V* col, V* gradient) {{
    const V* const AB = SU; const V* const AP = SU + 360; const V* const AS = SU + 720;
    const int fold[3][3] = {{{{0, 1, 2}}, {{1, 3, 4}}, {{2, 4, 5}}}};
    for (int i = 0; i < 60 * {_ROW}; ++i) H[i] = Z;
    for (int c = 0; c < 3; ++c) for (int i = 0; i < {COLUMNS}; ++i) {{
        for (int j = 0; j <= i; ++j) H[(5 * c + i) * {_ROW} + 5 * c + j] = AS[i * (i + 1) / 2 + j];
        gradient[5 * c + i] = AS[45 + 3 * i + c];
    }}
    for (int j = 0; j < {LOBES}; ++j) {{
        const int at = 15 + 10 * j; const V* const own = AP + 90 * j;
        for (int c = 0; c < 3; ++c) for (int i = 0; i < {COLUMNS}; ++i) {{
            const V s = col[5 * c + 1 + j];
            for (int m = 0; m < 9; ++m) H[(at + m) * {_ROW} + 5 * c + i] = s * own[9 * i + m];
            H[(at + 9) * {_ROW} + 5 * c + i] = s * AS[(5 + j) * (6 + j) / 2 + i];
        }}
        for (int m = 0; m < 9; ++m) gradient[at + m] = own[81 + m];
        gradient[at + 9] = AS[60 + j];
        for (int k = 0; k <= j; ++k) {{
            const int to = 15 + 10 * k; V s = Z;
            for (int c = 0; c < 3; ++c) s += col[5 * c + 1 + j] * col[5 * c + 1 + k];
            const V* const both = AB + 36 * (j * (j + 1) / 2 + k);
            for (int m = 0; m < 9; ++m) {{
                for (int i = 0; i < 9; ++i)
                    H[(at + m) * {_ROW} + to + i] = s * both[6 * fold[m / 3][i / 3] + fold[m % 3][i % 3]];
                H[(at + 9) * {_ROW} + to + m] = s * AP[90 * k + 9 * (5 + j) + m];
                if (k < j) H[(at + m) * {_ROW} + to + 9] = s * own[9 * (5 + k) + m];
            }}
            H[(at + 9) * {_ROW} + to + 9] = s * AS[(5 + j) * (6 + j) / 2 + 5 + k];
        }}
    }}
}};
"""

_SOLVE = f"""
// H x = x by Cholesky in place, four rows at a time; a pivot that rounding took is held up.
auto solve = [&](V* x) {{
    V inverse[{UNKNOWNS}];
    for (int j = 0; j < {UNKNOWNS}; ++j) {{
        const V* const rj = H + j * {_ROW}; const V floor = rj[j] * 1e-6f + 1e-30f;
        for (int i = j; i < {UNKNOWNS}; i += 4) {{
            V* const ri = H + i * {_ROW};
            V s0 = ri[j], s1 = ri[{_ROW} + j], s2 = ri[{2 * _ROW} + j], s3 = ri[{3 * _ROW} + j];
            for (int k = 0; k < j; ++k) {{
                const V v = rj[k];
                s0 -= ri[k] * v; s1 -= ri[{_ROW} + k] * v; s2 -= ri[{2 * _ROW} + k] * v; s3 -= ri[{3 * _ROW} + k] * v;
            }}
            if (i == j) {{ s0 = most(s0, floor); inverse[j] = 1.0f / root(s0); }}
            const V t = inverse[j];
            ri[j] = s0 * t; ri[{_ROW} + j] = s1 * t; ri[{2 * _ROW} + j] = s2 * t; ri[{3 * _ROW} + j] = s3 * t;
        }}
    }}
    for (int i = 0; i < {UNKNOWNS}; ++i) {{
        V s = x[i]; for (int k = 0; k < i; ++k) s -= H[i * {_ROW} + k] * x[k];
        x[i] = s * inverse[i];
    }}
    for (int i = {UNKNOWNS - 1}; i >= 0; --i) {{
        V s = x[i]; for (int k = i + 1; k < {UNKNOWNS}; ++k) s -= H[k * {_ROW} + i] * x[k];
        x[i] = s * inverse[i];
    }}
}};
// What may not move: a colour at 0, an exponent that its gradient pushes over a bound. Damping as Marquardt's, by the
// diagonal; a stiff spring along M itself, a direction that the colours already span.
auto damp = [&](const V* th, const V* col, V damping, V* gradient) {{
    auto freeze = [&](int i, I8 still) {{
        for (int k = 0; k <= i; ++k) H[i * {_ROW} + k] = select(still, Z, H[i * {_ROW} + k]);
        for (int k = i + 1; k < {UNKNOWNS}; ++k) H[k * {_ROW} + i] = select(still, Z, H[k * {_ROW} + i]);
        H[i * {_ROW} + i] = select(still, Z + 1.0f, H[i * {_ROW} + i]);
        gradient[i] = select(still, Z, gradient[i]);
    }};
    for (int i = 0; i < 15; ++i) {{
        H[i * {_ROW} + i] = H[i * {_ROW} + i] * 1.00001f + ridge; gradient[i] -= ridge * col[i];
        freeze(i, col[i] <= 0.0f);
    }}
    for (int j = 0; j < {LOBES}; ++j) {{
        const int at = 15 + 10 * j; const V* const m = th + 10 * j; V size = Z + 1e-20f, trace = Z;
        for (int i = 0; i < 9; ++i) {{ size += m[i] * m[i]; trace += H[(at + i) * {_ROW} + at + i]; }}
        for (int i = 0; i < 10; ++i) {{
            V& own = H[(at + i) * {_ROW} + at + i]; own += damping * own + 1e-9f * (trace + 1.0f);
        }}
        const V spring = trace / (9.0f * size), push = gradient[at + 9];
        for (int i = 0; i < 9; ++i) for (int k = 0; k <= i; ++k) H[(at + i) * {_ROW} + at + k] += spring * m[i] * m[k];
        freeze(at + 9, ((m[9] >= most_n) & (push > 0.0f)) | ((m[9] <= least_n) & (push < 0.0f)));
    }}
}};
"""

_SETUP = f"""
const int padded = (pairs + {CHUNK - 1}) / {CHUNK} * {CHUNK};
const float* const outer = outer_array.data; const float* const squares = squares_array.data;
const float* const diffuse_scale = diffuse_array.data; const float* const lobe_scale = lobe_array.data;
const float* const gauge_lights = gauge_array.data;
const float least_n = -0.6931471806f, most_n = 5.2983173665f;
float* at = scratch.data + (long long)slot * (padded * {_PAIR_WORDS}ll + {_FIXED_WORDS + 64});
at += (16 - ((unsigned long long)at / 4) % 16) % 16;
auto take = [&](long long vectors) {{ V* const v = (V*)at; at += {LANES} * vectors; return v; }};
V* const Y = take(3 * padded); V* const WT = take(padded); V* const PP = take(4 * padded);
V* const SU = take({_SUMS}); V* const buffer = take({74 * CHUNK}); V* const H = take({60 * _ROW});
"""

_FIT = f"""
int job[{LANES}], texel[{LANES}];
const int here = job_count - block * {LANES} < {LANES} ? job_count - block * {LANES} : {LANES};
for (int l = 0; l < {LANES}; ++l) {{
    job[l] = jobs.data[block * {LANES} + (l < here ? l : here - 1)]; texel[l] = job[l] % texels;
}}
// The data in units of the texel's mean; a black texel stays 0.
V top = Z, mean = Z;
for (int k = 0; k < padded; ++k) for (int c = 0; c < 3; ++c) {{
    V v = Z;
    if (k < pairs) for (int l = 0; l < {LANES}; ++l) v[l] = data.data[((long long)k * texels + texel[l]) * 3 + c];
    Y[3 * k + c] = v; top = most(top, v);
}}
const V shrink = select(top > 1e-30f, 1.0f / most(top, Z + 1e-30f), Z);
for (int k = 0; k < 3 * pairs; ++k) {{ Y[k] *= shrink; mean += Y[k]; }}
mean = mean / (3.0f * pairs);
const V stretch = select(mean > 0.0f, 1.0f / most(mean, Z + 1e-12f), Z);
for (int k = 0; k < 3 * pairs; ++k) Y[k] *= stretch;
for (int k = 0; k < padded; ++k) WT[k] = Z + (k < pairs ? 1.0f : 0.0f);

V col[15], th[{10 * LOBES}], loss, damping, stalled, steps, gradient[{UNKNOWNS}];
auto number = [&](int i) {{
    V v; for (int l = 0; l < {LANES}; ++l) v[l] = state.data[(long long)job[l] * {STATE} + i];
    return v;
}};
for (int i = 0; i < 15; ++i) col[i] = number(i);
for (int i = 0; i < {10 * LOBES}; ++i) th[i] = number(15 + i);
damping = number({DAMPING}); stalled = number({STALLED}); steps = number({STEPS});
if (restart) {{ gauge(th); stalled = Z; steps = Z; }}
powers(th);
if (restart) colours(col);
loss = loss_of(col);
bool fresh = true;
for (int iteration = 0; iteration < iterations; ++iteration) {{
    const I8 active = (stalled < {STALL}.0f) & (damping < {HARDEST}f) & (loss > {EXACT}f);
    if (!any(active)) break;
    if (fresh) gram(th, col);
    assemble(col, gradient);
    damp(th, col, damping, gradient);
    solve(gradient);
    V next[{10 * LOBES}], tint[15];
    for (int j = 0; j < {LOBES}; ++j) {{
        for (int i = 0; i < 9; ++i)
            next[10 * j + i] = th[10 * j + i] + least(most(gradient[15 + 10 * j + i], Z - 0.5f), Z + 0.5f);
        const V n = th[10 * j + 9] + least(most(gradient[24 + 10 * j], Z - 1.0f), Z + 1.0f);
        next[10 * j + 9] = least(most(n, Z + least_n), Z + most_n);
    }}
    gauge(next); powers(next); colours(tint);
    const V found = loss_of(tint);
    const I8 better = (found < loss) & active, worse = ~better & active;
    const I8 little = better & (loss - found < tolerance * loss);
    stalled = select(little, stalled + 1.0f, select(better, Z, stalled));
    loss = select(better, found, loss);
    for (int i = 0; i < {10 * LOBES}; ++i) th[i] = select(better, next[i], th[i]);
    for (int i = 0; i < 15; ++i) col[i] = select(better, tint[i], col[i]);
    damping = select(better, most(0.3f * damping, Z + 1e-6f), select(worse, 4.0f * damping, damping));
    steps = select(active, steps + 1.0f, steps);
    fresh = any(better);
}}
if (normals_wanted) {{ gram(th, col); assemble(col, gradient); }}
const V scale = top * mean;
for (int l = 0; l < here; ++l) {{
    float* const to = state.data + (long long)job[l] * {STATE};
    for (int i = 0; i < 15; ++i) to[i] = col[i][l];
    for (int i = 0; i < {10 * LOBES}; ++i) to[15 + i] = th[i][l];
    to[{LOSS}] = loss[l]; to[{DAMPING}] = damping[l]; to[{STALLED}] = stalled[l]; to[{STEPS}] = steps[l];
    to[{SCALE}] = scale[l];
    if (normals_wanted) {{
        float* const into = normals.data + (long long)job[l] * {UNKNOWNS * (UNKNOWNS + 1)};
        for (int i = 0; i < {UNKNOWNS}; ++i) {{
            for (int k = 0; k <= i; ++k) into[i * {UNKNOWNS} + k] = into[k * {UNKNOWNS} + i] = H[i * {_ROW} + k][l];
            into[{UNKNOWNS * UNKNOWNS} + i] = gradient[i][l];
        }}
    }}
}}
"""

FIT = HEAD + _SETUP + _COLOURS + _GRAM + _SOLVE + _FIT
"""Some steps of Levenberg–Marquardt on eight texels."""

EVALUATE = (
    HEAD
    + f"""
int texel[{LANES}];
const int here = texels - block * {LANES} < {LANES} ? texels - block * {LANES} : {LANES};
V v[55];
for (int l = 0; l < {LANES}; ++l) texel[l] = block * {LANES} + (l < here ? l : here - 1);
for (int i = 0; i < 55; ++i) for (int l = 0; l < {LANES}; ++l) v[i][l] = parameters.data[texel[l] * 55ll + i];
for (int k = 0; k < pairs; ++k) {{
    V y[3]; for (int c = 0; c < 3; ++c) y[c] = v[c] * diffuse_array.data[k];
    for (int j = 0; j < {LOBES}; ++j) {{
        const V* const own = v + 3 + 13 * j; V q, lg;
        const V p = lobe(own + 3, own[12], outer_array.data + 9 * k, q, lg) * lobe_array.data[k];
        for (int c = 0; c < 3; ++c) y[c] += own[c] * p;
    }}
    float* const to = result.data + ((long long)k * texels + block * {LANES}) * 3;
    for (int l = 0; l < here; ++l) for (int c = 0; c < 3; ++c) to[3 * l + c] = y[c][l];
}}
"""
)
"""The values of eight texels under all pairs."""
