"""A step of Adam over feature grids or packed weights in one pass over memory, and how they are rounded (NTBC §3.4).

Words lie flat, level by level, and are worked on in blocks of :data:`BLOCK`, none of which straddles two levels; within
a block by strips of 64. A strip whose gradients are zero in all parts costs no more than reading them: the update is
*lazy*, and a word without gradient keeps its value and moments.

What the network reads is written in the same pass. Codes of a grid depend on the range of their level (Eq. 4, 5), which
the pass keeps by blocks: words are rounded with the level's last scale and zero, and only where these turn out to have
changed does a second pass, :func:`grid_round_kernel`, round the whole level. CPU only.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.row_products import VECTORS

wp.set_module_options(dispatch.module_options())

BLOCK = 4096
"""Words that one thread owns."""

STRIP = 64
"""Words that are skipped together where no gradient reaches them."""

VALUE, HALF, CODE = 1, 2, 3
"""What ``used`` is: the value, the value as float16 holds it, or as its level's codes do."""


def block_table(offsets, words: int) -> np.ndarray:
    """Return (begin, end, level) of every block, [blocks, 3] int32; ``offsets`` are where the levels begin."""
    rows = []
    for level, (begin, end) in enumerate(zip(offsets, (*offsets[1:], words), strict=True)):
        starts = np.arange(begin, end, BLOCK)
        rows.append(np.stack([starts, np.minimum(starts + BLOCK, end), np.full_like(starts, level)], 1))
    return np.concatenate(rows).astype(np.int32)


_CODE = f"""{VECTORS}
const int begin = table.data[3 * block], end = table.data[3 * block + 1], level = table.data[3 * block + 2];
const float scale = scales.data[level], zero = zeros.data[level], last = (float)((1 << bits) - 1);
// Eq. 1 and 3; adding 1.5 * 2^23 leaves no place for a fraction, so that the sum is rounded to even.
auto coded = [&](V x) {{
    const V n = (x / scale + 12582912.0f) - 12582912.0f + zero;
    const V low = n > 0.0f ? n : Z;
    return ((low < last ? low : Z + last) - zero) * scale;
}};
"""

_ADAM = f"""{_CODE}
const int STRIP = {STRIP};
auto smaller = [](V a, V b) {{ return a < b ? a : b; }};
auto larger = [](V a, V b) {{ return a > b ? a : b; }};
// x as float16 holds it, rounded to even: by carries in the bits, or where float16 has no exponent left, by a sum whose
// last place is its last place.
auto half = [](V x) {{
    const I8 sign = (I8)x & (int)0x80000000, size = (I8)x & 0x7fffffff;
    I8 coarse = (size + 0xfff + ((size >> 13) & 1)) & ~0x1fff;
    coarse = coarse > 0x477fe000 ? I8{{}} + 0x7f800000 : coarse;
    coarse = size > 0x7f800000 ? size : coarse;  // no number
    const V fine = ((V)size + 0.5f) - 0.5f;
    return (V)(sign | (size < 0x38800000 ? (I8)fine : coarse));
}};
const bool update = flags.data[0], every = flags.data[1];
const int use = flags.data[2];
const I8 always = I8{{}} - (lazy ? 0 : 1);
const float gain = numbers.data[0], root = numbers.data[1];
const bool code = use == {CODE} && !every;
V low_before = Z, high_before = Z, low_after = Z, high_after = Z;
float sum[STRIP], copies[4][STRIP];
for (int at = begin; at < end; at += STRIP) {{
    // The last strip of a level goes through copies, filled up with zeros.
    const int count = end - at < STRIP ? end - at : STRIP;
    const bool whole = count == STRIP;
    for (int k = 0; k < STRIP; k += 8) *(V*)(sum + k) = Z;
    bool some = false;
    if (update) for (int p = 0; p < parts; ++p) {{
        float* const g = gradients.data + (long long)p * words + at;
        if (whole) {{
            I8 bits = {{}};
            for (int k = 0; k < STRIP; k += 8) bits |= *(const I8*)(g + k);
            long long any = 0;
            for (int k = 0; k < 8; ++k) any |= bits[k];
            if (!any) continue;
            for (int k = 0; k < STRIP; k += 8) {{
                *(V*)(sum + k) += *(const V*)(g + k);
                *(V*)(g + k) = Z;
            }}
            some = true;
        }} else for (int k = 0; k < count; ++k) {{
            if (g[k] == 0.0f) continue;
            sum[k] += g[k]; g[k] = 0.0f; some = true;
        }}
    }}
    if (!some && lazy && !every) continue;
    float *value = values.data + at, *m = mean.data + at, *v = square.data + at, *out = used.data + at;
    if (!whole) {{
        for (int k = 0; k < 4 * STRIP; ++k) copies[0][k] = 0.0f;
        for (int k = 0; k < count; ++k) {{ copies[0][k] = value[k]; copies[1][k] = m[k]; copies[2][k] = v[k]; }}
        value = copies[0]; m = copies[1]; v = copies[2]; out = copies[3];
    }}
    for (int k = 0; k < STRIP; k += 8) {{
        V x = *(const V*)(value + k);
        low_before = smaller(x, low_before); high_before = larger(x, high_before);
        if (update && (some || !lazy)) {{
            const V g = *(const V*)(sum + k), m0 = *(const V*)(m + k), v0 = *(const V*)(v + k);
            const I8 moves = (I8)(g != 0.0f) | always;
            const V m1 = m0 + (g - m0) * gain_mean, v1 = v0 * keep_square + g * g * gain_square;
            x = select(moves, x - gain * m1 / (__builtin_elementwise_sqrt(v1) * root + eps), x);
            *(V*)(value + k) = x;
            *(V*)(m + k) = select(moves, m1, m0);
            *(V*)(v + k) = select(moves, v1, v0);
        }}
        if (use == {VALUE}) *(V*)(out + k) = x;
        if (use == {HALF}) *(V*)(out + k) = half(x);
        if (code) *(V*)(out + k) = coded(x);
        low_after = smaller(x, low_after); high_after = larger(x, high_after);
    }}
    if (!whole) for (int k = 0; k < count; ++k) {{
        values.data[at + k] = value[k]; mean.data[at + k] = m[k]; square.data[at + k] = v[k];
        if (use != {CODE} || code) used.data[at + k] = out[k];
    }}
}}
if (use != {CODE}) return;
// The range of the block, which always has 0 in it, is looked for anew where a word that bounded it has moved inward.
auto least = [](V x) {{ float y = x[0]; for (int k = 1; k < 8; ++k) y = x[k] < y ? x[k] : y; return y; }};
auto most = [](V x) {{ float y = x[0]; for (int k = 1; k < 8; ++k) y = x[k] > y ? x[k] : y; return y; }};
float low = ranges.data[2 * block], high = ranges.data[2 * block + 1];
const float low_now = least(low_after), high_now = most(high_after);
if (every || (least(low_before) <= low && low_now > low) || (most(high_before) >= high && high_now < high)) {{
    V a = Z, b = Z;
    int at = begin;
    for (; at + 8 <= end; at += 8) {{
        const V x = *(const V*)(values.data + at);
        a = smaller(x, a); b = larger(x, b);
    }}
    for (; at < end; ++at) {{ a = smaller(Z + values.data[at], a); b = larger(Z + values.data[at], b); }}
    low = least(a); high = most(b);
}}
ranges.data[2 * block] = low_now < low ? low_now : low;
ranges.data[2 * block + 1] = high_now > high ? high_now : high;
"""

_ROUND = f"""{_CODE}
if (!changed.data[level]) return;
int at = begin;
for (; at + 8 <= end; at += 8) *(V*)(used.data + at) = coded(*(const V*)(values.data + at));
for (; at < end; ++at) used.data[at] = coded(Z + values.data[at])[0];
"""


@wp.func_native(_ADAM)
def _adam_block(
    block: int,
    parts: int,
    words: int,
    lazy: int,
    bits: int,
    gain_mean: float,
    keep_square: float,
    gain_square: float,
    eps: float,
    table: wp.array(dtype=wp.int32),
    flags: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.float32),
    scales: wp.array(dtype=wp.float32),
    zeros: wp.array(dtype=wp.float32),
    gradients: wp.array(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
    mean: wp.array(dtype=wp.float32),
    square: wp.array(dtype=wp.float32),
    used: wp.array(dtype=wp.float32),
    ranges: wp.array(dtype=wp.float32),
): ...


@wp.func_native(_ROUND)
def _round_block(
    block: int,
    bits: int,
    table: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
    scales: wp.array(dtype=wp.float32),
    zeros: wp.array(dtype=wp.float32),
    changed: wp.array(dtype=wp.uint8),
    used: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def grid_adam_kernel(
    first: int,
    parts: int,
    words: int,
    lazy: int,
    bits: int,
    gain_mean: float,
    keep_square: float,
    gain_square: float,
    eps: float,
    table: wp.array(dtype=wp.int32),
    flags: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.float32),
    scales: wp.array(dtype=wp.float32),
    zeros: wp.array(dtype=wp.float32),
    # outputs
    gradients: wp.array(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
    mean: wp.array(dtype=wp.float32),
    square: wp.array(dtype=wp.float32),
    used: wp.array(dtype=wp.float32),
    ranges: wp.array(dtype=wp.float32),
):
    """Update the block of each thread: sum and clear the parts of its gradient, then Adam.

    ``gain_mean`` is 1 − β₁, ``keep_square`` β₂, ``gain_square`` 1 − β₂. ``flags`` are (whether there is an update,
    whether words without gradient are gone through, which of :data:`VALUE`, :data:`HALF` and :data:`CODE` ``used`` is);
    ``numbers`` are rate / (1 − β₁ᵗ) and 1 / √(1 − β₂ᵗ). ``ranges`` [blocks, 2] are the lowest and highest value of each
    block, or 0 where that is beyond them; they are kept up to date only where ``used`` is codes.
    """
    _adam_block(
        first + wp.tid(), parts, words, lazy, bits, gain_mean, keep_square, gain_square, eps, table, flags, numbers,
        scales, zeros, gradients, values, mean, square, used, ranges,
    )  # fmt: skip


@wp.kernel
def grid_round_kernel(
    first: int,
    bits: int,
    table: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
    scales: wp.array(dtype=wp.float32),
    zeros: wp.array(dtype=wp.float32),
    changed: wp.array(dtype=wp.uint8),
    # outputs
    used: wp.array(dtype=wp.float32),
):
    """Round the block of each thread to codes of its level and back, where scale or zero of the level have changed."""
    _round_block(first + wp.tid(), bits, table, values, scales, zeros, changed, used)
