"""C++ of the BC6H decoder, written out from the format's tables: shifts, masks and constants that a compiler sees.

:func:`block_code` decodes whole blocks with vectors of a CPU core, :func:`texel_code` one texel with plain integers, on
any device. Both begin with the same jump to the code of the block's mode, which collects the endpoints of each channel
in one 64-bit word: endpoint e, as stored, in bits 16e … 16e + 15.

A block in vectors: the three words are 16 short lanes, which a handful of instructions resolves and unquantises. Then,
8 texels at a time, one instruction multiplies the pair of endpoints (a, b) by (64 − w, w) and adds; its 16-bit factors
are signed, so unsigned endpoints are moved down by 2^15 before and up again after the division by 64, which changes
nothing because 2^15 · 64 is a multiple of 64. Scaling by 31/64 (31/32) is the upper half of a 16-bit product.
"""

from warp_neumat.kernels.bc6h_tables import ANCHOR, INDEX_BIT, MODES, PARTITION_BIT, PARTITIONS, WEIGHTS3

_MODE10 = MODES[9]


# ---- code generation: bits of a block to its endpoints -------------------------------------------------------------


def _terms(mode, channel: int) -> list[str]:
    """C++ terms whose bitwise or is the word of a channel; bits that move by the same distance share one."""
    terms: dict[tuple[str, int], int] = {}
    for position, (c, endpoint, bit) in enumerate(mode.fields, mode.mode_bits):
        if c == channel:
            source, base = ("lo", 0) if position < 64 else ("hi", 64)
            target = 16 * endpoint + bit
            key = (source, target - (position - base))
            terms[key] = terms.get(key, 0) | 1 << (position - base)
    return [
        f"(({source} & {mask:#x}ull) {'<<' if shift >= 0 else '>>'} {abs(shift)})"
        for (source, shift), mask in terms.items()
    ]


def _cases(mode) -> str:
    """C++ labels of the five-bit values that select a mode."""
    values = range(mode.bits, 32, 1 << mode.mode_bits)
    return " ".join(f"case {value}:" for value in values)


def _words(mode) -> str:
    return " ".join(f"{name} = {' | '.join(_terms(mode, c))};" for c, name in enumerate("RGB"))


# ---- CPU: vectors of one block -------------------------------------------------------------------------------------


def _lanes16(values) -> str:
    """C++ constant of 16 short lanes from 4 endpoints × 3 channels; the last four lanes are unused."""
    return "(V16){" + ", ".join(str(v if v < 1 << 15 else v - (1 << 16)) for v in values) + "}"


def _short(value: int) -> str:
    """C++ constant of 16 equal short lanes."""
    return _lanes16([value & 0xFFFF] * 16)


def _unquantize(mode, signed: bool) -> str:
    """C++ from the words R, G, B to ``Q``: unquantised endpoints in 16 lanes, unsigned ones less 2^15."""
    p = mode.precision
    text = ["V16 E = (V16)(V4L){(long long)R, (long long)G, (long long)B, 0};"]
    if mode.transformed:
        sign = [0 if e == 0 else 1 << (mode.delta[c] - 1) for c in range(3) for e in range(4)] + [0] * 4
        other = [0 if e == 0 else 0xFFFF for _ in range(3) for e in range(4)] + [0] * 4
        text.append(
            f"E = (E ^ {_lanes16(sign)}) - {_lanes16(sign)};"
            "E += __builtin_shufflevector(E, E, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12)"
            f" & {_lanes16(other)};"
        )
        if p < 16:
            text.append(f"E &= {_short((1 << p) - 1)};")
    if signed:
        if p < 16:
            text.append(f"E = (E ^ {_short(1 << p - 1)}) - {_short(1 << p - 1)};")
            text.append("V16 S = E < 0; V16 M = (E ^ S) - S;")
            text.append(f"Q = (M << {16 - p}) + {_short(0x4000 >> p - 1)};")
            text.append(f"Q = (M >= {_short((1 << p - 1) - 1)}) ? {_short(0x7FFF)} : Q;")
            text.append("Q &= M != 0; Q = (Q ^ S) - S;")
        else:
            text.append("Q = E;")
    elif p < 16:
        text.append(f"Q = (E << {16 - p}) + {_short(0x8000 >> p)};")
        text.append(f"Q |= E == {_short((1 << p) - 1)}; Q &= E != 0; Q ^= {_short(0x8000)};")
    else:
        text.append(f"Q = E ^ {_short(0x8000)};")
    return " ".join(text)


_VECTORS = """
typedef long long V4L __attribute__((vector_size(32)));
typedef int V8 __attribute__((vector_size(32)));
typedef short V16 __attribute__((vector_size(32)));
typedef unsigned short U16 __attribute__((vector_size(32)));
typedef unsigned int U8 __attribute__((vector_size(32)));
typedef unsigned int U16W __attribute__((vector_size(64)));
typedef short V8S __attribute__((vector_size(16)));
typedef V8S V8SU __attribute__((aligned(1), may_alias));
typedef unsigned long long u64;
typedef u64 u64u __attribute__((aligned(1), may_alias));
#define BC6H_SPLAT(v, l) __builtin_shufflevector(v, v, l, l, l, l, l, l, l, l)
// A pair of weights is 64 - w below and w above, that is 64 + 65535 w; w is WEIGHTS4 or WEIGHTS3, index * 64/15 or
// 64/7 rounded.
#define BC6H_WEIGHTS4(index) (((((V8)(index) & 15) * 68 + 8) >> 4) * 0xffff + 64)
#if defined(__AVX2__) && !defined(BC6H_PORTABLE)
#define BC6H_MADD(a, b) ((V8)__builtin_ia32_pmaddwd256((V16)(a), (V16)(b)))
#define BC6H_PACK(a, b) ((V16)__builtin_ia32_packssdw256(a, b))
#define BC6H_WEIGHTS3(index) ((V8)__builtin_ia32_permvarsi256(W3, (V8)(index)))
#define BC6H_REGION(pairs, r, c) ((V8)__builtin_ia32_permvarsi256(pairs, (r) + 2 * (c)))
#else
#define BC6H_MADD(a, b) ((((a) << 16) >> 16) * (((b) << 16) >> 16) + ((a) >> 16) * ((b) >> 16))
#define BC6H_PACK(a, b) __builtin_shufflevector((V16)(a), (V16)(b), 0, 2, 4, 6, 16, 18, 20, 22,\
 8, 10, 12, 14, 24, 26, 28, 30)
#define BC6H_WEIGHTS3(index) (((((V8)(index) & 7) * 146 + 8) >> 4) * 0xffff + 64)
#define BC6H_REGION(pairs, r, c) ((r) != 0 ? BC6H_SPLAT(pairs, 2 * (c) + 1) : BC6H_SPLAT(pairs, 2 * (c)))
#endif
"""

# The two vectors of a block hold texels 0-3, 8-11 and 4-7, 12-15, so that packing them to shorts gives texel order.
_FIRST = (0, 1, 2, 3, 8, 9, 10, 11)
_SECOND = (4, 5, 6, 7, 12, 13, 14, 15)


def _pair(weight) -> int:
    """The two weights of a texel as one 32-bit lane: 64 − w below, w above."""
    return (64 - int(weight)) | int(weight) << 16


def _ints(values) -> str:
    return "(V8){" + ", ".join(str(v) for v in values) + "}"


def _tables() -> str:
    """C++ tables by partition: the region of each texel in vector order, and the index bits above the anchor's."""
    rows = ", ".join(
        "{" + ", ".join(str(int(mask) >> t & 1) for t in _FIRST + _SECOND) + "}" for mask in PARTITIONS
    )  # fmt: skip
    above = ", ".join(f"{(1 << 48) - (1 << 3 * int(a) + 2):#x}ull" for a in ANCHOR)
    return (
        f"alignas(32) static const int region[32][16] = {{{rows}}};\nstatic const u64 above[32] = {{{above}}};\n"
        f"const V8 W3 = {_ints(map(_pair, WEIGHTS3))};\n"
    )


def _two_region_texels() -> str:
    """C++ from Q and the block to six sums: for each channel, two vectors of 8 texels."""
    return (
        f"const int part = (int)(hi >> {PARTITION_BIT - 64}) & 31;"
        f"u64 x = hi >> {INDEX_BIT[2] - 64}; x += x & ~3ull; x += x & above[part];"
        # An anchor's missing top bit is put back by moving everything above it up by one: adding it to itself.
        "const int xl = (int)x, xh = (int)(x >> 24);"
        "const U8 X = {(unsigned)xl, (unsigned)xl, (unsigned)xl, (unsigned)xl,"
        " (unsigned)xh, (unsigned)xh, (unsigned)xh, (unsigned)xh};"
        "const V8 wa = BC6H_WEIGHTS3((X >> (U8){0, 3, 6, 9, 0, 3, 6, 9}));"
        "const V8 wb = BC6H_WEIGHTS3((X >> (U8){12, 15, 18, 21, 12, 15, 18, 21}));"
        "const V8 ra = *(const V8*)region[part], rb = *(const V8*)(region[part] + 8);"
        "const V8 P = (V8)Q;"
        "s0 = BC6H_MADD(BC6H_REGION(P, ra, 0), wa); s1 = BC6H_MADD(BC6H_REGION(P, rb, 0), wb);"
        "s2 = BC6H_MADD(BC6H_REGION(P, ra, 1), wa); s3 = BC6H_MADD(BC6H_REGION(P, rb, 1), wb);"
        "s4 = BC6H_MADD(BC6H_REGION(P, ra, 2), wa); s5 = BC6H_MADD(BC6H_REGION(P, rb, 2), wb);"
    )


def _one_region_texels() -> str:
    """C++ as :func:`_two_region_texels`, for 4-bit indices and one pair of endpoints."""

    return (
        f"u64 x = hi >> {INDEX_BIT[1] - 64}; x += x & ~7ull;"
        "const int xl = (int)x, xh = (int)(x >> 32);"
        "const U8 X = {(unsigned)xl, (unsigned)xl, (unsigned)xl, (unsigned)xl,"
        " (unsigned)xh, (unsigned)xh, (unsigned)xh, (unsigned)xh};"
        "const V8 wa = BC6H_WEIGHTS4((X >> (U8){0, 4, 8, 12, 0, 4, 8, 12}));"
        "const V8 wb = BC6H_WEIGHTS4((X >> (U8){16, 20, 24, 28, 16, 20, 24, 28}));"
        "const V8 P = (V8)Q, pr = BC6H_SPLAT(P, 0), pg = BC6H_SPLAT(P, 2), pb = BC6H_SPLAT(P, 4);"
        "s0 = BC6H_MADD(pr, wa); s1 = BC6H_MADD(pr, wb); s2 = BC6H_MADD(pg, wa); s3 = BC6H_MADD(pg, wb);"
        "s4 = BC6H_MADD(pb, wa); s5 = BC6H_MADD(pb, wb);"
    )


def _finish(signed: bool) -> str:
    """C++ from the six sums to the 96 bytes of the block: divide by 64, scale by 31/64 (31/32), interleave, store."""
    text = ["V16 c0 = BC6H_PACK((s0 + 32) >> 6, (s1 + 32) >> 6), c1 = BC6H_PACK((s2 + 32) >> 6, (s3 + 32) >> 6);"]
    text.append("V16 c2 = BC6H_PACK((s4 + 32) >> 6, (s5 + 32) >> 6);")
    for c in ("c0", "c1", "c2"):
        high = "__builtin_convertvector((__builtin_convertvector((U16){}, U16W) * {}u) >> 16, U16)"
        if signed:
            # The specification drops the sign of what scales to zero: −1.
            text.append(f"{{ const V16 n = {c} < 0; const V16 m = ({c} ^ n) - n;")
            text.append(f"{c} = (V16){high.format('m', 31 << 11)} | (({c} < -1) & {_short(0x8000)}); }}")
        else:
            text.append(f"{c} ^= {_short(0x8000)}; {c} = (V16){high.format(c, 31 << 10)};")
    # Texel i of channel c goes to place 3i + c of its row pair's 24: within a vector of 8 to place (3i + c) mod 8, all
    # different, so each channel is permuted once and the three vectors of output only choose between channels.
    for c in range(3):
        order = [next(i for i in range(8) if (3 * i + c) % 8 == place) for place in range(8)]
        both = ", ".join(str(i) for i in order + [8 + i for i in order])
        text.append(f"c{c} = __builtin_shufflevector(c{c}, c{c}, {both});")
    for k in range(3):
        rg = [16 * ((8 * k + place) % 3 == 1) + place for place in range(8)]
        rgb = [16 * ((8 * k + place) % 3 == 2) + place for place in range(8)]
        for name, a, b, pick in ((f"m{k}", "c0", "c1", rg), (f"o{k}", f"m{k}", "c2", rgb)):
            both = ", ".join(str(i) for i in pick + [8 + i for i in pick])
            text.append(f"const V16 {name} = __builtin_shufflevector({a}, {b}, {both});")
    for k in range(3):
        for half in range(2):
            lanes = ", ".join(str(8 * half + i) for i in range(8))
            text.append(
                f"*(V8SU*)(out + {48 * half + 16 * k}) = __builtin_shufflevector(o{k}, o{k}, {lanes});"
            )  # fmt: skip
    return "\n".join(text)


def block_code(signed: bool, *, portable: bool = False) -> str:
    """Return C++ that decodes ``count`` blocks from block ``first`` on: ``blocks`` uint8 to ``pixels`` float16.

    ``portable`` leaves out what only AVX2 has, as on a core without it.
    """
    load = "const u64 lo = *(const u64u*)in, hi = *(const u64u*)(in + 8);"
    state = "u64 R = 0, G = 0, B = 0; V16 Q; V8 s0, s1, s2, s3, s4, s5;"
    cases = "\n".join(
        f"{_cases(mode)} {{ {_words(mode)} {_unquantize(mode, signed)} two = {int(mode.regions == 2)}; break; }}"
        for mode in MODES
    )
    zero = f"default: {{ Q = {_short(0 if signed else 0x8000)}; two = 0; }}"
    return f"""
{"#define BC6H_PORTABLE" if portable else ""}
{_VECTORS}
{_tables()}
const unsigned char* in = (const unsigned char*)blocks.data + (size_t)first * 16;
unsigned char* out = (unsigned char*)pixels.data + (size_t)first * 96;
const unsigned char* const end = in + (size_t)count * 16;
while (in < end) {{
    // A run of mode 10 needs no jump. Looking ahead eight blocks at a time keeps the test itself off the clock.
    while (end - in >= 128) {{
        int differ = 0;
        for (int k = 0; k < 128; k += 16) differ |= in[k] ^ {_MODE10.bits};
        if (differ & 31) break;
        for (int k = 0; k < 8; ++k, in += 16, out += 96) {{
            {load}
            {state}
            {_words(_MODE10)} {_unquantize(_MODE10, signed)}
            {_two_region_texels()}
            {_finish(signed)}
        }}
    }}
    for (int k = 0; k < 8 && in < end; ++k, in += 16, out += 96) {{
        {load}
        {state}
        int two;
        switch ((int)lo & 31) {{
        {cases}
        {zero}
        }}
        if (two) {{ {_two_region_texels()} }} else {{ {_one_region_texels()} }}
        {_finish(signed)}
    }}
}}
"""


# ---- any device: one texel -----------------------------------------------------------------------------------------


def texel_code() -> str:
    """Return C++ that decodes one texel: block bits ``lo`` and ``hi``, ``texel`` 0 … 15, ``is_signed``.

    It returns the bits of the three half floats, red lowest.
    """
    cases = "\n".join(
        f"{_cases(mode)} {_words(mode)} two = {int(mode.regions == 2)}; p = {mode.precision};"
        f" delta = {_packed_delta(mode)}; break;"
        for mode in MODES
    )
    partitions = ", ".join(f"{int(mask) | int(a) << 16:#x}u" for mask, a in zip(PARTITIONS, ANCHOR, strict=True))
    return f"""
typedef unsigned long long u64;
static const unsigned partitions[32] = {{{partitions}}};
u64 R, G, B;
int two, p, delta;
switch ((int)lo & 31) {{
{cases}
default: return 0;
}}
// Indices: an anchor's missing top bit is put back by moving everything above it up by one.
int region = 0, w;
if (two) {{
    const unsigned shape = partitions[(int)(hi >> {PARTITION_BIT - 64}) & 31];
    region = (int)(shape >> texel) & 1;
    u64 x = hi >> {INDEX_BIT[2] - 64};
    x += x & ~3ull;
    x += x & ~((4ull << 3 * (shape >> 16)) - 1);
    w = (((int)(x >> 3 * texel) & 7) * 146 + 8) >> 4;  // WEIGHTS3: index · 64/7, rounded
}} else {{
    u64 x = hi >> {INDEX_BIT[1] - 64};
    x += x & ~7ull;
    w = (((int)(x >> 4 * texel) & 15) * 68 + 8) >> 4;  // WEIGHTS4: index · 64/15, rounded
}}
// Selections instead of jumps: what a jump would depend on is as good as random from texel to texel. Shifts by
// precision 16 leave 16-bit endpoints as they are.
const int mask = (1 << p) - 1, top = 1 << (p - 1), down = 16 - p, half_step = 0x8000 >> p;
const int other = delta ? -1 : 0, first = 32 * region;
u64 result = 0;
for (int c = 0; c < 3; ++c) {{
    const u64 word = c == 0 ? R : c == 1 ? G : B;
    const int base = (int)word & 0xffff & other;
    const int sign = (1 << (delta >> 4 * c & 15) >> 1) & other;
    const int b = (int)(word >> (first + 16)) & 0xffff, a = (int)(word >> first) & 0xffff;
    int v[2] = {{region ? (a ^ sign) - sign + base : a, (b ^ sign) - sign + base}};
    for (int e = 0; e < 2; ++e) {{
        const int x = v[e] & mask;
        if (is_signed) {{
            const int y = (x ^ top) - top, size = y < 0 ? -y : y;
            const int wide = size >= top - 1 && p < 16 ? 0x7fff : size ? (size << down) + half_step : 0;
            v[e] = y < 0 ? -wide : wide;
        }} else {{
            v[e] = x == mask ? 0xffff : x ? (x << down) + half_step : 0;
        }}
    }}
    const int y = (v[0] * (64 - w) + v[1] * w + 32) >> 6;
    const int size = y < 0 ? -y : y;
    // What scales to zero has no sign.
    const int half = is_signed ? size * 31 >> 5 | (y < -1 ? 0x8000 : 0) : y * 31 >> 6;
    result |= (u64)half << 16 * c;
}}
return result;
"""


def _packed_delta(mode) -> int:
    """Bits of the differences, 4 per channel, red lowest; 0 where endpoints are stored as they are."""
    return sum(bits << 4 * c for c, bits in enumerate(mode.delta)) if mode.transformed else 0
