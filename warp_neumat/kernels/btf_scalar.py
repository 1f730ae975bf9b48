"""Plain C++ of a neural BTF for one thread of CUDA: the arithmetic of :mod:`~.btf_code` lane by lane.

A block is one lane, which is then its own item, or the four of one quad.
"""

from warp_neumat.kernels.btf_code import LEVEL, SEAM, activation_code, table_code

_FETCH = """
auto finite = [](float a) -> float { return a - a == 0.0f ? a : 0.0f; };
// Texels on both sides of a coordinate, and its place between them; see btf_code.fetch_code.
auto axis = [](float a, int size, int& x0, int& x1) -> float {
    a -= rintf(a);
    a = a == a ? a : 0.0f;  // one that is no number: 0
    float whole = floorf(a * (float)size - 0.5f), part = fmaf(a, (float)size, -0.5f - whole);
    whole = part < 0.0f ? whole - 1.0f : whole;
    part = part < 0.0f ? part + 1.0f : part;
    x0 = (int)whole;
    x0 = x0 < 0 ? x0 + size : x0;
    x1 = x0 + 1 < size ? x0 + 1 : 0;
    return part;
};
auto half_of = [](unsigned short bits) -> float {
    // Shifted into place, a half is a float 2^112 too small, denormal ones included.
    const unsigned wide = (bits & 0x7FFFu) << 13;
    float size; memcpy(&size, &wide, 4);
    size *= 5.192296858534828e33f;
    return bits & 0x8000u ? -size : size;
};

const int* const lv = levels.data + level_at;
const unsigned short* const tx = texels.data;
const float* const w = weights.data + weight_at;
const int top = lv[0] - 1;
auto level_of = [&](float s) -> int {
    s = s > 0.0f ? s : 0.0f;
    return (int)((s < (float)top ? s : (float)top) + 0.5f);
};
auto fetch = [&](float u, float v, int level, int column, int padded, int channels, float* x) {
    const int* const rec = lv + 1 + LEVEL * level + column;
    const int width = rec[0], height = rec[1];
    int x0, x1, y0, y1;
    const float fx = axis(u, width, x0, x1), fy = axis(v, height, y0, y1);
    const unsigned short* const first = tx + 8ll * rec[2];
    const long long a = (long long)padded * (y0 * width + x0), b = (long long)padded * (y0 * width + x1);
    const long long c = (long long)padded * (y1 * width + x0), d = (long long)padded * (y1 * width + x1);
    const float fxy = fx * fy;
    for (int k = 0; k < channels; ++k)
        x[k] = half_of(first[a + k]) * (1.0f - fx - fy + fxy) + half_of(first[b + k]) * (fx - fxy)
             + half_of(first[c + k]) * (fy - fxy) + half_of(first[d + k]) * fxy;
};
""".replace("LEVEL", str(LEVEL))

_LAYER = """
auto dense = [&](const float* w, const float* start, const float* x, int inputs, int outputs, bool hidden, float* y) {
    for (int o = 0; o < outputs; ++o) {
        float a = start ? start[o] : 0.0f;
        for (int k = 0; k < inputs; ++k) a += w[k * outputs + o] * x[k];
        y[o] = hidden ? act(a) : a;
    }
};
"""


def _tail(widths, weights: int, hidden: bool) -> str:
    """Return C++ of the layers behind the first, from h0; the result is in ``last``."""
    text, source = ["const float* last = h0;"], 0
    layers = list(zip(widths[:-1], widths[1:], strict=True))
    for n, (i, o) in enumerate(layers):
        used = "true" if hidden or n < len(layers) - 1 else "false"
        text.append(f"dense(w + {weights + o}, w + {weights}, h{source}, {i}, {o}, {used}, h{1 - source});")
        source, weights = 1 - source, weights + o + i * o
        text.append(f"last = h{source};")
    return " ".join(text)


def view_code(layout, lanes: int) -> str:
    """Return C++ that prepares a block for its lights."""
    fine, coarse = layout.fine, layout.coarse
    most = 3 + max(fine.channels, coarse.channels if coarse else 0)
    text = [_FETCH, activation_code(layout.activation, "float"), _LAYER, table_code(layout, lanes), f"float x[{most}];"]
    if not coarse:
        text.append(f"""
for (int j = 0; j < count; ++j) {{
    const int l = active.data[j];
    for (int c = 0; c < 3; ++c) seen[3 * l + c] = x[c] = wo.data[c * {lanes} + l];
    fetch(place.data[l], place.data[{lanes} + l], level_of(place.data[{2 * lanes} + l]), 0,
          {layout.padded(fine.channels)}, {fine.channels}, x + 3);
    dense(w + {layout.at("fine view") + fine.hidden[0]}, w + {layout.at("fine view")}, x, {3 + fine.channels},
          {fine.hidden[0]}, false, fine + {fine.hidden[0]} * l);
}}
""")
        return "\n".join(text)
    text.append(f"""
bool together = {"false" if lanes == 1 else "!alone"};
float u = 0.0f, v = 0.0f, s = 0.0f, d[3] = {{}};
float low[2] = {{3.4e38f, 3.4e38f}}, high[2] = {{-3.4e38f, -3.4e38f}};
for (int j = 0; j < count; ++j) for (int c = 0; c < 2; ++c) {{
    const float a = finite(place.data[c * {lanes} + active.data[j]]);
    low[c] = a < low[c] ? a : low[c]; high[c] = a > high[c] ? a : high[c];
}}
for (int j = 0; j < count; ++j) {{
    const int l = active.data[j];
    const float part = 1.0f / (float)count;
    // The mean counts from the least one, whose whole part is dropped: as precise far from 0 as near to it.
    for (int c = 0; c < 2; ++c) (c ? v : u) += (finite(place.data[c * {lanes} + l]) - low[c]) * part;
    s += place.data[{2 * lanes} + l] * part;
    for (int c = 0; c < 3; ++c) d[c] += wo.data[c * {lanes} + l];
}}
u += low[0] - rintf(low[0]);
v += low[1] - rintf(low[1]);
int level = level_of(s);
for (int c = 0; c < 2; ++c) if ((high[c] - low[c]) * (float)lv[1 + {LEVEL} * level + c] > {SEAM}f) together = false;
head[0] = together;
for (int j = 0; j < count; ++j) {{
    const int l = active.data[j];
    if (!together) {{
        u = place.data[l]; v = place.data[{lanes} + l]; level = level_of(place.data[{2 * lanes} + l]);
        for (int c = 0; c < 3; ++c) d[c] = wo.data[c * {lanes} + l];
    }}
    if (!together || j == 0) {{
        const float r = d[0] * d[0] + d[1] * d[1] + d[2] * d[2], scale = 1.0f / sqrtf(r > 1e-30f ? r : 1e-30f);
        for (int c = 0; c < 3; ++c) seen[3 * l + c] = x[c] = d[c] * scale;
        fetch(u, v, level, 3, {layout.padded(coarse.channels)}, {coarse.channels}, x + 3);
        dense(w + {layout.at("coarse view") + coarse.hidden[0]}, w + {layout.at("coarse view")}, x,
              {3 + coarse.channels}, {coarse.hidden[0]}, false, coarse + {coarse.hidden[0]} * l);
        head[1] = l;
    }}
    fetch(place.data[l], place.data[{lanes} + l], level, 0, {layout.padded(fine.channels)}, {fine.channels}, x);
    dense(w + {layout.at("fine view") + fine.hidden[0]}, w + {layout.at("fine view")}, x, {fine.channels},
          {fine.hidden[0]}, false, fine + {fine.hidden[0]} * l);
}}
""")
    return "\n".join(text)


def light_code(layout, lanes: int) -> str:
    """Return C++ that evaluates a light."""
    fine, coarse = layout.fine, layout.coarse
    entering = 6 if layout.half_vector else 3
    widest = max(*fine.hidden, 3, *((*coarse.hidden, layout.latent) if coarse else ()))
    half = """
    const float p = a[0] + o[0], q = a[1] + o[1], r = a[2] + o[2], length2 = p * p + q * q + r * r;
    const bool good = length2 > 1e-12f;
    const float scale = good ? 1.0f / sqrtf(length2) : 0.0f;
    a[3] = p * scale; a[4] = q * scale; a[5] = good ? r * scale : 1.0f;
"""
    head = f"""
const float* const w = weights.data + weight_at;
{activation_code(layout.activation, "float")}
{_LAYER}
{table_code(layout, lanes)}
float h0[{widest}], h1[{widest}], a[6];
auto angles = [&](const float* o) {{ (void)o; {half if layout.half_vector else ""} }};
auto give = [&](const float* y, int l) {{
    for (int c = 0; c < 3; ++c) {{
        const float s = y[c] > 0.0f ? y[c] : 0.0f;
        value.data[c * {lanes} + l] = s < 3e38f ? s : 3e38f;
    }}
}};
"""
    fine_tail = _tail((*fine.hidden, 3), layout.at("fine tail"), False)
    wide = fine.hidden[0]
    if not coarse:
        return f"""{head}
for (int j = 0; j < count; ++j) {{
    const int l = active.data[j];
    for (int c = 0; c < 3; ++c) a[c] = wi.data[c * {lanes} + l];
    angles(seen + 3 * l);
    dense(w + {layout.at("fine light")}, fine + {wide} * l, a, {entering}, {wide}, true, h0);
    {fine_tail} give(last, l);
}}
"""
    return f"""{head}
float share[{wide}], d[3] = {{}};
for (int j = 0; j < count; ++j) for (int c = 0; c < 3; ++c) d[c] += wi.data[c * {lanes} + active.data[j]];
for (int j = 0; j < count; ++j) {{
    const int l = active.data[j], at = head[0] ? head[1] : l;
    if (!head[0] || j == 0) {{
        if (!head[0]) for (int c = 0; c < 3; ++c) d[c] = wi.data[c * {lanes} + l];
        const float r = d[0] * d[0] + d[1] * d[1] + d[2] * d[2], scale = 1.0f / sqrtf(r > 1e-30f ? r : 1e-30f);
        for (int c = 0; c < 3; ++c) a[c] = d[c] * scale;
        angles(seen + 3 * at);
        dense(w + {layout.at("coarse light")}, coarse + {coarse.hidden[0]} * at, a, {entering}, {coarse.hidden[0]},
              true, h0);
        {{ {_tail((*coarse.hidden, layout.latent), layout.at("coarse tail"), True)}
        dense(w + {layout.at("latent")}, nullptr, last, {layout.latent}, {wide}, false, share); }}
    }}
    for (int k = 0; k < {wide}; ++k) {{
        const float s = fine[{wide} * l + k] + share[k];
        h0[k] = act(s);
    }}
    {fine_tail} give(last, l);
}}
"""
