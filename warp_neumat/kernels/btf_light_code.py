"""C++ of a neural BTF's light: the layers behind what the view has left in its rows and groups (``btf_code``)."""

from warp_neumat.kernels.btf_code import activation_code, batch, layer, table_code, tail, vector_types

# Writes the half vector behind a row's ω_i; o is ω_o.
_HALF = """
auto half = [&](float* a, const float* o) __attribute__((always_inline)) {
    for (int i = 0; i < ROW; i += NV) {
        const V p = *(V*)(a + i) + *(const V*)(o + i), q = *(V*)(a + ROW + i) + *(const V*)(o + ROW + i);
        const V r = *(V*)(a + 2 * ROW + i) + *(const V*)(o + 2 * ROW + i);
        const V d = p * p + q * q + r * r;
        const V s = 1.0f / __builtin_elementwise_sqrt(d > 1e-12f ? d : Z + 1e-12f);
        *(V*)(a + 3 * ROW + i) = d > 1e-12f ? p * s : Z;
        *(V*)(a + 4 * ROW + i) = d > 1e-12f ? q * s : Z;
        *(V*)(a + 5 * ROW + i) = d > 1e-12f ? r * s : Z + 1.0f;
    }
};
"""

# Which lanes the light reaches: all that the view has, or those of the list.
_LIT = """
const bool whole = count == head[2];
const float* reached = mask;
alignas(64) float marks[LANES];
if (!whole) {
    memset(marks, 0, sizeof marks);
    for (int j = 0; j < count; ++j) marks[active.data[j]] = 1.0f;
    reached = marks;
}
(void)reached;
auto lit = [&](int r) {
    if (whole) return true;
    float any = 0.0f;
    for (int i = 0; i < ROW; ++i) any += marks[lane[r * ROW + i]];
    return any > 0.0f;
};
"""

_FINISH = """
auto finish = [](float* y) __attribute__((always_inline)) {
    for (int k = 0; k < 3 * ROW; k += NV) {
        V s = *(V*)(y + k);
        s = s > 0.0f ? s : (V){};
        *(V*)(y + k) = s < 3e38f ? s : (V){} + 3e38f;
    }
};
"""

# Four rows of a group of whole quads: the lanes of a quad lie beside each other.
_STORE_QUADS = """
auto store_quads = [&](const float* y, const int* from) __attribute__((always_inline)) {
    for (int c = 0; c < 3; ++c) for (int i = 0; i < ROW; i += 8) {
        const float* const t = y + c * ROW + i;
        const V8 s0 = *(const V8*)t, s1 = *(const V8*)(t + 3 * ROW);
        const V8 s2 = *(const V8*)(t + 6 * ROW), s3 = *(const V8*)(t + 9 * ROW);
        const V8 t0 = __builtin_shufflevector(s0, s1, 0, 8, 1, 9, 4, 12, 5, 13);
        const V8 t1 = __builtin_shufflevector(s0, s1, 2, 10, 3, 11, 6, 14, 7, 15);
        const V8 t2 = __builtin_shufflevector(s2, s3, 0, 8, 1, 9, 4, 12, 5, 13);
        const V8 t3 = __builtin_shufflevector(s2, s3, 2, 10, 3, 11, 6, 14, 7, 15);
        V8 q[4];
        q[0] = __builtin_shufflevector(t0, t2, 0, 1, 8, 9, 4, 5, 12, 13);
        q[1] = __builtin_shufflevector(t0, t2, 2, 3, 10, 11, 6, 7, 14, 15);
        q[2] = __builtin_shufflevector(t1, t3, 0, 1, 8, 9, 4, 5, 12, 13);
        q[3] = __builtin_shufflevector(t1, t3, 2, 3, 10, 11, 6, 7, 14, 15);
        float* const to = value.data + c * LANES;
        _Pragma("clang loop unroll(full)")
        for (int k = 0; k < 4; ++k) {
            *(V4*)(to + 4 * from[i + k]) = __builtin_shufflevector(q[k], q[k], 0, 1, 2, 3);
            *(V4*)(to + 4 * from[i + 4 + k]) = __builtin_shufflevector(q[k], q[k], 4, 5, 6, 7);
        }
    }
};
"""

# Sums of ω_i over the lit lanes of each quad, eight quads at a time.
_SUMS = """
alignas(64) float sum[3 * LANES / 4];
for (int c = 0; c < 3; ++c) for (int q = 0; q < LANES / 4; q += 8) {
    V8 p[4];
    _Pragma("clang loop unroll(full)")
    for (int k = 0; k < 4; ++k)
        p[k] = *(const V8*)(reached + 4 * q + 8 * k) > 0.0f ? *(const V8*)(wi.data + c * LANES + 4 * q + 8 * k) : V8{};
    *(V8*)(sum + c * (LANES / 4) + q) = fold(p[0], p[1], p[2], p[3], plus);
}
"""


def light_code(layout, lanes: int, vector: int) -> str:
    """Return C++ that evaluates a light for the rows and groups that it reaches."""
    fine, coarse = layout.fine, layout.coarse
    widest = max(*fine.hidden, *((*coarse.hidden, layout.latent) if coarse else ()))
    pitch = f"({widest} * ROW)"
    text = [
        vector_types(vector), activation_code(layout.activation, "V"),
        "const float* const w = weights.data + weight_at;", table_code(layout, lanes),
        _LIT, _HALF if layout.half_vector else "", _FINISH,
        f"enum {{ BATCH = {batch(widest)} }};",
        f"alignas(64) float h0[BATCH * {pitch}], h1[BATCH * {pitch}], y[4 * 3 * ROW], a[6 * ROW];",
        _coarse(layout, lanes, vector, pitch) if coarse else _single(layout, lanes, vector, pitch),
    ]  # fmt: skip
    return "\n".join(text).replace("LANES", str(lanes))


def _single(layout, lanes: int, vector: int, pitch: str) -> str:
    """C++ of a network that sees the angles of every lane."""
    fine, half = layout.fine, "half(a, seen + r * 3 * ROW);" if layout.half_vector else ""
    start, wide = f"(fine + r * {fine.hidden[0]} * ROW)", fine.hidden[0]
    begin = layer(6 if half else 3, wide, f"(w + {layout.at('fine light')})", "a", f"(h0 + t * {pitch})", vector,
                  start=start)  # fmt: skip
    return f"""
int list[LANES / ROW], count_lit = 0;
for (int r = 0; r < head[1]; ++r) if (lit(r)) list[count_lit++] = r;
for (int first = 0; first < count_lit; first += BATCH) {{
    const int rows = count_lit - first < BATCH ? count_lit - first : BATCH;
    for (int t = 0; t < rows; ++t) {{
        const int r = list[first + t];
        const int* const at = lane + r * ROW;
        if (dense[r]) for (int c = 0; c < 3; ++c)
            memcpy(a + c * ROW, wi.data + c * LANES + at[0], 4 * ROW);
        else for (int i = 0; i < ROW; ++i) for (int c = 0; c < 3; ++c) a[c * ROW + i] = wi.data[c * LANES + at[i]];
        {half}
        {begin}
    }}
    {tail((*fine.hidden, 3), layout.at("fine tail"), "(y + t * 3 * ROW)", "rows", pitch, vector, hidden=False)}
    for (int t = 0; t < rows; ++t) {{
        const int* const at = lane + list[first + t] * ROW;
        float* const from = y + t * 3 * ROW;
        finish(from);
        if (dense[list[first + t]]) for (int c = 0; c < 3; ++c)
            memcpy(value.data + c * LANES + at[0], from + c * ROW, 4 * ROW);
        else for (int i = 0; i < ROW; ++i) for (int c = 0; c < 3; ++c)
            value.data[c * LANES + at[i]] = from[c * ROW + i];
    }}
}}
"""


def _coarse(layout, lanes: int, vector: int, pitch: str) -> str:
    """C++ of a coarse network for each group and a fine one for each of its rows."""
    fine, coarse, latent = layout.fine, layout.coarse, layout.latent
    wide, half = fine.hidden[0], "half(a, view + g * 3 * ROW);" if layout.half_vector else ""
    start = f"(coarse + g * {coarse.hidden[0]} * ROW)"
    begin = layer(6 if half else 3, coarse.hidden[0], f"(w + {layout.at('coarse light')})", "a",
                  f"(h0 + t * {pitch})", vector, start=start)  # fmt: skip
    spread = layer(latent, wide, f"(w + {layout.at('latent')})", f"(z + t * {latent} * ROW)",
                   f"(share + t * {wide} * ROW)", vector, hidden=False, start="0")  # fmt: skip
    inner = tail((*coarse.hidden, latent), layout.at("coarse tail"), f"(z + t * {latent} * ROW)", "some", pitch,
                 vector, hidden=True)  # fmt: skip
    outer = tail((*fine.hidden, 3), layout.at("fine tail"), "(out + t * 3 * ROW)", "many", pitch, vector, hidden=False)
    return f"""
{_SUMS}
{_STORE_QUADS}
alignas(64) float z[BATCH * {latent} * ROW], share[BATCH * {wide} * ROW];
int list[LANES / ROW + 1], count_lit = 0;
for (int g = 0; g < head[0]; ++g) {{
    bool any = false;
    for (int r = row_of[g]; r < row_of[g + 1] && !any; ++r) any = lit(r);
    if (any) list[count_lit++] = g;
}}
for (int first = 0; first < count_lit; first += BATCH) {{
    const int some = count_lit - first < BATCH ? count_lit - first : BATCH;
    for (int t = 0; t < some; ++t) {{
        const int g = list[first + t];
        const int* const from = source + g * ROW;
        if (dense[g] == 2) for (int c = 0; c < 3; ++c)
            memcpy(a + c * ROW, sum + c * (LANES / 4) + from[0], 4 * ROW);
        else for (int i = 0; i < ROW; ++i) for (int c = 0; c < 3; ++c)
            a[c * ROW + i] = from[i] < LANES / 4 ? sum[c * (LANES / 4) + from[i]]
                                                 : wi.data[c * LANES + from[i] - LANES / 4];
        unit(a);
        {half}
        {begin}
    }}
    {inner}
    for (int t = 0; t < some; ++t) {spread}
    for (int n = 0; n < some; ++n) {{
        const int g = list[first + n], begin = row_of[g], deep = row_of[g + 1] - begin;
        int reach[4], rows = 0;
        for (int k = 0; k < deep; ++k) if (lit(begin + k)) reach[rows++] = begin + k;
        for (int k = 0; k < rows; k += BATCH) {{
            const int many = rows - k < BATCH ? rows - k : BATCH;
            float* const out = y + k * 3 * ROW;
            const float* const both = share + n * {wide} * ROW;
            for (int t = 0; t < many; ++t) {{
                const float* const own_sum = fine + reach[k + t] * {wide} * ROW;
                float* const to = h0 + t * {pitch};
                _Pragma("clang loop unroll_count(4)")
                for (int i = 0; i < {wide} * ROW; i += NV) {{
                    const V s = *(const V*)(own_sum + i) + *(const V*)(both + i);
                    *(V*)(to + i) = act(s);
                }}
            }}
            {outer}
        }}
        for (int k = 0; k < rows; ++k) finish(y + k * 3 * ROW);
        if (dense[g] && rows == 4) store_quads(y, source + g * ROW);
        else for (int k = 0; k < rows; ++k) for (int i = 0; i < ROW; ++i) for (int c = 0; c < 3; ++c)
            value.data[c * LANES + lane[reach[k] * ROW + i]] = y[(k * 3 + c) * ROW + i];
    }}
}}
"""
