"""C++ of a neural BTF's view: lanes become items and rows, textures are fetched, first layers begun (``btf_code``)."""

from warp_neumat.kernels.btf_code import LEVEL, SEAM, TEXTURES, fetch_code, layer, table_code, vector_types

_PLACES = """
const int* const lv = levels.data + level_at;
const unsigned short* const tx = texels.data;
const float* const w = weights.data + weight_at;
const int top = lv[0] - 1;
auto level_of = [&](float s) __attribute__((always_inline)) -> int {
    s = s > 0.0f ? s : 0.0f;
    return (int)((s < (float)top ? s : (float)top) + 0.5f);
};
"""


_IN_TURN = """
auto in_turn = [](const int* x) {
    int wrong = 0;
    for (int i = 0; i < ROW; ++i) wrong |= x[i] - x[0] - i;
    return wrong == 0;
};
"""


def _means(lanes: int) -> str:
    """C++ of what is known of the quads: means over wanted lanes, their number, their level, whether they are apart."""
    quads = lanes // 4
    return f"""
alignas(32) float mean[5][{quads}], lanes_of_quad[{quads}], lod[{quads}], width[2][{quads}];
int level[{quads}], apart[{quads}];
memset(mask, 0, {4 * lanes});
for (int j = 0; j < count; ++j) mask[active.data[j]] = 1.0f;
for (int q = 0; q < {quads}; q += 8) {{
    const float* const m = mask + 4 * q;
    auto chosen = [&](const float* x, int k, V8 other) __attribute__((always_inline)) {{
        return *(const V8*)(m + 8 * k) > 0.0f ? *(const V8*)(x + 4 * q + 8 * k) : other;
    }};
    auto total = [&](const float* x) __attribute__((always_inline)) {{
        const V8 zero = {{}};
        return fold(chosen(x, 0, zero), chosen(x, 1, zero), chosen(x, 2, zero), chosen(x, 3, zero), plus);
    }};
    const V8 number = total(mask), part = 1.0f / (number > 1.0f ? number : (V8){{}} + 1.0f);
    *(V8*)(lanes_of_quad + q) = number;
    *(V8*)(lod + q) = total(place.data + {2 * lanes}) * part;
    for (int c = 0; c < 3; ++c) *(V8*)(mean[2 + c] + q) = total(wo.data + c * {lanes});
    for (int c = 0; c < 2; ++c) {{
        V8 x[4], low[4], high[4];
        _Pragma("clang loop unroll(full)")
        for (int k = 0; k < 4; ++k) {{
            const V8 a = *(const V8*)(place.data + c * {lanes} + 4 * q + 8 * k), zero = {{}};
            const V8 wanted = *(const V8*)(m + 8 * k);
            x[k] = a - a == 0.0f ? a : zero;
            low[k] = wanted > 0.0f ? x[k] : zero + 3.4e38f;
            high[k] = wanted > 0.0f ? -x[k] : zero + 3.4e38f;
        }}
        // The mean counts from the least, whose whole part is dropped: as precise far from 0 as near to it.
        const V8 least_of_quad = fold(low[0], low[1], low[2], low[3], least);
        _Pragma("clang loop unroll(full)")
        for (int k = 0; k < 4; ++k) {{
            const V8 from = k == 0 ? __builtin_shufflevector(least_of_quad, least_of_quad, 0, 0, 0, 0, 1, 1, 1, 1)
                          : k == 1 ? __builtin_shufflevector(least_of_quad, least_of_quad, 2, 2, 2, 2, 3, 3, 3, 3)
                          : k == 2 ? __builtin_shufflevector(least_of_quad, least_of_quad, 4, 4, 4, 4, 5, 5, 5, 5)
                                   : __builtin_shufflevector(least_of_quad, least_of_quad, 6, 6, 6, 6, 7, 7, 7, 7);
            x[k] = *(const V8*)(m + 8 * k) > 0.0f ? x[k] - from : (V8){{}};
        }}
        *(V8*)(mean[c] + q) = least_of_quad - __builtin_elementwise_rint(least_of_quad)
                            + fold(x[0], x[1], x[2], x[3], plus) * part;
        *(V8*)(width[c] + q) = -fold(high[0], high[1], high[2], high[3], least) - least_of_quad;
    }}
}}
int split = 0;
for (int q = 0; q < {quads}; ++q) {{
    const int* const rec = lv + 1 + {LEVEL} * (level[q] = level_of(lod[q]));
    apart[q] = (width[0][q] * (float)rec[0] > {SEAM}f) | (width[1][q] * (float)rec[1] > {SEAM}f);
    split |= apart[q] & (lanes_of_quad[q] > 0.0f);
}}
"""


def _items(lanes: int) -> str:
    """C++ that arranges the wanted lanes: it writes the parts of the scratch that ``btf.Layout.parts`` describes."""
    quads = lanes // 4
    return f"""
int items = 0, lanes_of[{lanes} + ROW];
if (alone) {{
    for (int j = 0; j < count; ++j) {{ source[j] = {quads} + active.data[j]; lanes_of[j] = 1; }}
    items = count;
}} else if (count == {lanes} && !split) {{
    for (int q = 0; q < {quads}; ++q) {{ source[q] = q; lanes_of[q] = 4; }}
    items = {quads};
}} else for (int n = 4; n > 0; --n) {{
    for (int q = 0; q < {quads}; ++q)
        if (lanes_of_quad[q] == (float)n && !apart[q]) {{ source[items] = q; lanes_of[items++] = n; }}
    if (n == 1) for (int q = 0; q < {quads}; ++q) if (apart[q]) for (int k = 0; k < 4; ++k)
        if (mask[4 * q + k] > 0.0f) {{ source[items] = {quads} + 4 * q + k; lanes_of[items++] = 1; }}
}}
const int groups = (items + ROW - 1) / ROW;
for (; items < groups * ROW; ++items) {{ source[items] = source[items - 1]; lanes_of[items] = lanes_of[items - 1]; }}
int rows = 0;
for (int g = 0; g < groups; ++g) {{
    const int* const from = source + g * ROW;
    const int deep = lanes_of[g * ROW];
    row_of[g] = rows;
    dense[g] = lanes_of[g * ROW + ROW - 1] == 4;
    if (dense[g]) {{
        dense[g] += in_turn(from);
        for (int k = 0; k < 4; ++k) for (int i = 0; i < ROW; ++i) lane[(rows + k) * ROW + i] = 4 * from[i] + k;
    }} else for (int i = 0; i < ROW; ++i) {{
        int found[4] = {{from[i] - {quads}, from[i] - {quads}, from[i] - {quads}, from[i] - {quads}}};
        if (from[i] < {quads}) {{
            int n = 0;
            for (int k = 0; k < 4; ++k) if (mask[4 * from[i] + k] > 0.0f) found[n++] = 4 * from[i] + k;
            // Where an item has no further lane its first is computed again, which writes the same value.
            for (; n < 4; ++n) found[n] = found[0];
        }}
        for (int k = 0; k < deep; ++k) lane[(rows + k) * ROW + i] = found[k];
    }}
    rows += deep;
}}
row_of[groups] = rows;
head[0] = groups; head[1] = rows; head[2] = count;
"""


def _coarse(layout, lanes: int, vector: int) -> str:
    """C++ of the coarse texture and what the coarse network's first layer knows of the view, for all groups."""
    quads, coarse = lanes // 4, layout.coarse
    first = coarse.hidden[0]
    target = f"(coarse + g * {first} * ROW)"
    return f"""{{
{fetch_code(coarse.channels, layout.padded(coarse.channels), 3)}
auto gather = [&](int g) {{
    float* const out = view + g * 3 * ROW;
    const int* const from = source + g * ROW;
    if (dense[g] == 2) {{
        memcpy(u, mean[0] + from[0], 4 * ROW); memcpy(v, mean[1] + from[0], 4 * ROW);
        memcpy(m, level + from[0], 4 * ROW);
        for (int c = 0; c < 3; ++c) memcpy(out + c * ROW, mean[2 + c] + from[0], 4 * ROW);
    }} else for (int i = 0; i < ROW; ++i) {{
        const int q = from[i] & {quads - 1}, l = from[i] < {quads} ? 4 * q : from[i] - {quads};
        const bool quad = from[i] < {quads};
        u[i] = quad ? mean[0][q] : place.data[l]; v[i] = quad ? mean[1][q] : place.data[{lanes} + l];
        m[i] = quad ? level[q] : level_of(place.data[{2 * lanes} + l]);
        for (int c = 0; c < 3; ++c) out[c * ROW + i] = quad ? mean[2 + c][q] : wo.data[c * {lanes} + l];
    }}
    find(u, v, m, ring[g & 3]);
    unit(out);
}};
for (int turn = 0; turn < groups + 2; ++turn) {{
    if (turn < groups) gather(turn);
    if (turn < 2) continue;
    const int g = turn - 2;
    memcpy(x, view + g * 3 * ROW, 12 * ROW);
    filter(ring[g & 3], x + 3 * ROW);
    {layer(3 + coarse.channels, first, f"(w + {layout.at('coarse view')})", "x", target, vector, hidden=False)}
}}
}}"""


def view_code(layout, lanes: int, vector: int) -> str:
    """Return C++ that prepares a block for its lights."""
    quads, fine, coarse = lanes // 4, layout.fine, layout.coarse
    widest = max(3 + layout.padded(net.channels) for net in (fine, coarse) if net)
    text = [
        vector_types(vector), TEXTURES, _PLACES, _IN_TURN, table_code(layout, lanes),
        # Taps are found, and their cache lines asked for, two rows before they are filtered.
        f"alignas(64) float x[{widest} * ROW], u[ROW], v[ROW]; int m[ROW]; Taps ring[4];",
    ]  # fmt: skip
    level = advance = of_view = ""
    if coarse:
        text += [_means(lanes), _items(lanes), _coarse(layout, lanes, vector)]
        level = f"source[g * ROW + i] < {quads} ? level[source[g * ROW + i]] : "  # a lane's is that of its item
        advance = "while (row_of[g + 1] <= r) ++g;"
    else:
        of_view = f"""
    for (int c = 0; c < 3; ++c) for (int i = 0; i < ROW; ++i) x[c * ROW + i] = wo.data[c * {lanes} + from[i]];
    memcpy(seen + r * 3 * ROW, x, 12 * ROW);"""
        text.append("""
const int rows = (count + ROW - 1) / ROW;
for (int i = 0; i < rows * ROW; ++i) lane[i] = active.data[i < count ? i : count - 1];
for (int r = 0; r < rows; ++r) dense[r] = in_turn(lane + r * ROW);
head[0] = 0; head[1] = rows; head[2] = count;
""")
    seen = 0 if coarse else 3
    wide = fine.hidden[0]
    target = f"(fine + r * {wide} * ROW)"
    text.append(f"""
{fetch_code(fine.channels, layout.padded(fine.channels), 0)}
int g = 0; (void)g;
for (int turn = 0; turn < rows + 2; ++turn) {{
    if (turn < rows) {{
        const int r = turn; {advance}
        const int* const from = lane + r * ROW;
        for (int i = 0; i < ROW; ++i) {{
            u[i] = place.data[from[i]]; v[i] = place.data[{lanes} + from[i]];
            m[i] = {level}level_of(place.data[{2 * lanes} + from[i]]);
        }}
        find(u, v, m, ring[r & 3]);
    }}
    if (turn < 2) continue;
    const int r = turn - 2;
    const int* const from = lane + r * ROW; (void)from;{of_view}
    filter(ring[r & 3], x + {seen} * ROW);
    {layer(seen + fine.channels, wide, f"(w + {layout.at('fine view')})", "x", target, vector, hidden=False)}
}}
""")
    return "\n".join(text)
