"""C++ that fetches single texels from each storage of a feature texture, for the loops of :mod:`~.filter`.

Names inside: ``tx`` stored texels; ``fac``, ``region``, ``facts``, ``anchor``, ``modes``, ``ends``: the parts of
:func:`warp_neumat.kernels.bcf_storage.packed_tables`.
"""

from warp_neumat.kernels.bcf_storage import NIBBLES

_CACHE_BITS = 6  # unquantised blocks kept per call: neighbours in a picture share them


def vector_fetch(storage: str, signed: bool) -> str:
    """Return C++ of ``fetch`` for four texels at a time, on a CPU with AVX2 and F16C."""
    per_block, per_texel, byte = _NUMBERS[storage]
    head = f"const int PER_BLOCK = {per_block}, PER_TEXEL = {per_texel};"
    head += f"auto place = [&](int i) {{ return tx + {byte}; }};"
    if storage in _VECTOR:
        return head + _VECTOR[storage]
    texels = _TEXELS.replace("FINISH", _FINISH[signed])
    if storage == "unquantised":
        return head + texels.replace("TEXEL", _UNQUANTISED)
    decode = _DECODE.replace("WIDEN", _WIDEN[signed]).replace("KEEP_BITS", str(_CACHE_BITS))
    decode = decode.replace("KEEP", str(1 << _CACHE_BITS)).replace("NIBBLES", str(NIBBLES))
    return head + decode + texels.replace("TEXEL", _FROM_BLOCK)


def scalar_fetch(storage: str, signed: bool) -> str:
    """Return plain C++ of ``fetch`` for one texel."""
    if storage in _SCALAR_FETCH:
        return _SCALAR_FETCH[storage]
    texel = _SCALAR_TEXEL.replace("FINISH", _SCALAR_FINISH[signed])
    if storage == "unquantised":
        return texel + _SCALAR_UNQUANTISED
    return texel + _SCALAR_BLOCKS.replace("WIDEN", _SCALAR_WIDEN[signed]).replace("NIBBLES", str(NIBBLES))


# ---- vectors -----------------------------------------------------------------------------------------------------

# Four texels of a footprint, two a register: left column (upper, lower) and right column.
_HALF = """
auto fetch = [&](int a, int b, int c, int d, V& left, V& right) __attribute__((always_inline)) {
    const L2 l = {*(const long long*)(tx + 8ll * a), *(const long long*)(tx + 8ll * b)};
    const L2 r = {*(const long long*)(tx + 8ll * c), *(const long long*)(tx + 8ll * d)};
    left = __builtin_convertvector((H8)l, V);
    right = __builtin_convertvector((H8)r, V);
};
"""

_RGBA8 = """
typedef unsigned char B8 __attribute__((vector_size(8), aligned(1)));
auto fetch = [&](int a, int b, int c, int d, V& left, V& right) __attribute__((always_inline)) {
    typedef unsigned int P __attribute__((vector_size(8)));
    const P l = {*(const u32*)(tx + 4ll * a), *(const u32*)(tx + 4ll * b)};
    const P r = {*(const u32*)(tx + 4ll * c), *(const u32*)(tx + 4ll * d)};
    left = __builtin_convertvector((B8)l, V) * (1.0f / 255.0f);
    right = __builtin_convertvector((B8)r, V) * (1.0f / 255.0f);
};
"""

_DECODE = """
typedef unsigned char B16 __attribute__((vector_size(16), aligned(1), may_alias));
alignas(64) unsigned char kept[64 * KEEP]; int tags[KEEP];
for (int k = 0; k < KEEP; ++k) tags[k] = -1;
auto block_at = [&](int block) __attribute__((always_inline)) -> const unsigned char* {
    const unsigned slot = (unsigned)block * 0x9E3779B1u >> (32 - KEEP_BITS);
    unsigned char* const out = kept + 64 * slot;
    if (tags[slot] == block) return out;
    tags[slot] = block;
    const unsigned char* p = tx + 16ll * block;
    const unsigned long long lo = *(const u64*)p, hi = *(const u64*)(p + 8);
    const int mode = modes[lo & 31];
    const S16* e = (const S16*)ends + NIBBLES * 16 * mode;
    S16 x = e[lo & 15], y = e[16 + (lo >> 4 & 15)], z = e[32 + (lo >> 8 & 15)];
    _Pragma("clang loop unroll(full)")
    for (int k = 3; k < 15; k += 3) {
        x ^= e[16 * k + (lo >> 4 * k & 15)];
        y ^= e[16 * k + 16 + (lo >> (4 * k + 4) & 15)];
        z ^= e[16 * k + 32 + (lo >> (4 * k + 8) & 15)];
    }
    x ^= e[240 + (lo >> 60)]; y ^= e[256 + (hi & 15)]; z ^= e[272 + (hi >> 4 & 15)];
    x ^= e[288 + (hi >> 8 & 15)]; y ^= e[304 + (hi >> 12 & 15)]; z ^= e[320 + (hi >> 16 & 15)];
    x ^= y ^ z;
    const int* f = facts + 4 * mode;
    const I even = __builtin_shufflevector((I)x, (I)x, 0, 1, 2, 3, 0, 1, 2, 3) & 0xFFFF;
    const I odd = even << 16, upper = {0, 0, 0, 0, -1, -1, -1, -1};
    x += (S16)((odd | (even & upper)) & f[0]);
    WIDEN
    *(S16*)out = x;
    // 4 bits for each texel: the bits that anchors lack are put in, and 3 bits are spread to 4.
    unsigned long long bits; B16 side = {};
    if (f[3]) bits = ((hi >> 1 & ~7ull) << 1) | (hi >> 1 & 7);
    else {
        const int part = (int)(hi >> 13 & 31);
        const unsigned long long low = (4ull << 3 * anchor[part]) - 1;
        bits = hi >> 18;
        bits = (bits & 3) | (bits & ~3ull) << 1;
        bits = (bits & low) | (bits & ~low) << 1;
        bits = (bits & 0xFFFFFFull) | (bits & 0xFFFFFF000000ull) << 8;
        bits = (bits & 0x00000FFF00000FFFull) | (bits & 0x00FFF00000FFF000ull) << 4;
        bits = (bits & 0x003F003F003F003Full) | (bits & 0x0FC00FC00FC00FC0ull) << 2;
        bits = (bits & 0x0707070707070707ull) | (bits & 0x3838383838383838ull) << 1;
        side = *(const B16*)(region + 16 * part);
    }
    const L2 both = {(long long)(bits & 0x0F0F0F0F0F0F0F0Full), (long long)(bits >> 4 & 0x0F0F0F0F0F0F0F0Full)};
    B16 n = (B16)both;
    n = __builtin_shufflevector(n, n, 0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
    n += n; n += n; n += (unsigned char)(f[3] << 5);
    *(B16*)(out + 32) = __builtin_shufflevector(n, side, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    *(B16*)(out + 48) = __builtin_shufflevector(n, side, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    return out;
};
"""

_WIDEN = {
    False: """
    const S16 wide = x + (short)f[1], full = x == (short)f[2];
    x = ((wide | full) & (x != 0)) ^ (short)-32768;
""",
    True: """
    const S16 sign = x >> 15, size = (x ^ sign) - sign;
    const S16 wide = size >= (short)f[2] ? (S16){} + (short)0x7FFF : size + (short)f[1];
    x = ((wide & (size != 0)) ^ sign) - sign;
""",
}

_UNQUANTISED = """
        const unsigned char* p = tx + i;
        e[k] = *(const S8*)(tx + (i & ~63) + p[33]);
        w[k] = *(const int*)((const char*)fac + p[32]);
"""

_FROM_BLOCK = """
        const unsigned char* p = block_at(i >> 4);
        const unsigned char* code = p + 32 + 2 * (i & 15);
        e[k] = *(const S8*)(p + code[1]);
        w[k] = *(const int*)((const char*)fac + code[0]);
"""

_TEXELS = """
auto fetch = [&](int a, int b, int c, int d, V& left, V& right) __attribute__((always_inline)) {
    S8 e[4]; int w[4]; const int index[4] = {a, b, c, d};
    _Pragma("clang loop unroll(full)")
    for (int k = 0; k < 4; ++k) {
        const int i = index[k];
        TEXEL
    }
    const S16 eu = __builtin_shufflevector(e[0], e[2], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const S16 el = __builtin_shufflevector(e[1], e[3], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const I wu = {w[0], w[0], w[0], w[0], w[2], w[2], w[2], w[2]};
    const I wl = {w[1], w[1], w[1], w[1], w[3], w[3], w[3], w[3]};
    I u = (I)__builtin_ia32_pmaddwd256(eu, (S16)wu), l = (I)__builtin_ia32_pmaddwd256(el, (S16)wl);
    FINISH
    left = __builtin_convertvector((H8)__builtin_shufflevector(h, h, 0, 1, 2, 3, 4, 5, 6, 7), V);
    right = __builtin_convertvector((H8)__builtin_shufflevector(h, h, 8, 9, 10, 11, 12, 13, 14, 15), V);
};
"""

# The registers hold (upper left, upper right) and (lower left, lower right); packing each half of both gives a column.
# (v · 31) >> 6 is the upper half of the product with 31 · 2^10.
_FINISH = {
    False: """
    u = (I)((U)(u + 0x200020) >> 6); l = (I)((U)(l + 0x200020) >> 6);
    const S16 h = (S16)__builtin_ia32_pmulhuw256((S16)__builtin_ia32_packusdw256(u, l), (S16){} + (short)(31 << 10));
""",
    True: """
    const S16 v = (S16)__builtin_ia32_packssdw256((u + 32) >> 6, (l + 32) >> 6);
    const S16 sign = v >> 15, size = (v ^ sign) - sign;
    const S16 h = (S16)__builtin_ia32_pmulhuw256(size, (S16){} + (short)(31 << 11)) | (sign & (short)-32768);
""",
}

_NUMBERS = {
    "half": (16, 1, "8ll * i"),
    "rgba8": (16, 1, "4ll * i"),
    "unquantised": (64, 2, "i"),
    "blocks": (16, 1, "(long long)(i & ~15)"),
}
"""How the vector form numbers texels: PER_BLOCK, PER_TEXEL, and the byte at which what is read for number i begins."""

_VECTOR = {"half": _HALF, "rgba8": _RGBA8}


# ---- scalar ------------------------------------------------------------------------------------------------------

_SCALAR_HALF = """
auto half_of = [](unsigned bits) -> float {
    // Shifted into place, a half is a float 2^112 too small, denormal ones included.
    const unsigned wide = (bits & 0x7FFFu) << 13;
    float value; memcpy(&value, &wide, 4);
    value *= 5.192296858534828e33f;
    return bits & 0x8000u ? -value : value;
};
"""

_SCALAR_FETCH = {
    "half": _SCALAR_HALF
    + """
auto fetch = [&](int i, float* rgb) {
    const unsigned char* p = tx + 8ll * i;
    for (int c = 0; c < 3; ++c) rgb[c] = half_of(p[2 * c] | p[2 * c + 1] << 8);
};
""",
    "rgba8": """
auto fetch = [&](int i, float* rgb) {
    for (int c = 0; c < 3; ++c) rgb[c] = (float)tx[4ll * i + c] * (1.0f / 255.0f);
};
""",
}

_SCALAR_TEXEL = (
    _SCALAR_HALF
    + """
auto blend = [&](const short* pair, const short* w, float* rgb) {
    for (int c = 0; c < 3; ++c) {
        int s = pair[2 * c] * w[0] + pair[2 * c + 1] * w[1];
        FINISH
        rgb[c] = half_of((unsigned)s);
    }
};
"""
)

_SCALAR_FINISH = {
    False: "s = (((s + 0x200020) >> 6) * 31) >> 6;",
    True: "s = (s + 32) >> 6; s = s < 0 ? ((-s * 31) >> 5) | 0x8000 : (s * 31) >> 5;",
}

_SCALAR_UNQUANTISED = """
auto fetch = [&](int i, float* rgb) {
    const unsigned char* p = tx + 64ll * (i >> 4);
    const int t = i & 15;
    blend((const short*)(p + p[33 + 2 * t]), (const short*)((const char*)fac + p[32 + 2 * t]), rgb);
};
"""

_SCALAR_BLOCKS = """
auto fetch = [&](int i, float* rgb) {
    const unsigned char* p = tx + 16ll * (i >> 4);
    unsigned long long lo = 0, hi = 0;
    for (int k = 7; k >= 0; --k) { lo = lo << 8 | p[k]; hi = hi << 8 | p[8 + k]; }
    const int mode = modes[lo & 31], t = i & 15;
    const int* f = facts + 4 * mode;
    int q, side = 0;
    if (f[3]) q = (int)(hi >> (t ? 4 * t : 1)) & (t ? 15 : 7);
    else {
        const int part = (int)(hi >> 13 & 31), a = anchor[part];
        q = (int)(hi >> (18 + 3 * t - (t > 0) - (t > a))) & (t == 0 || t == a ? 3 : 7);
        side = region[16 * part + t] >> 4;
    }
    short pair[6];
    for (int c = 0; c < 3; ++c) {
        short word[3] = {0, 0, 0};
        const int at[3] = {2 * c, 8 * side + 2 * c, 8 * side + 2 * c + 1};
        for (int n = 0; n < 3; ++n) {
            for (int k = 0; k < NIBBLES; ++k) {
                const int v = (int)((k < 16 ? lo >> 4 * k : hi >> 4 * (k - 16)) & 15);
                word[n] ^= ends[16 * (16 * (NIBBLES * mode + k) + v) + at[n]];
            }
            if (n == 2 || (n == 1 && side)) word[n] = (short)(word[n] + (f[0] ? word[0] : 0));
        }
        for (int n = 1; n < 3; ++n) {
            const short x = word[n];
            WIDEN
            pair[2 * c + n - 1] = (short)wide;
        }
    }
    blend(pair, (const short*)(fac + q + 8 * f[3]), rgb);
};
"""

_SCALAR_WIDEN = {
    False: "int wide = (unsigned short)x + f[1]; if (x == (short)f[2]) wide = 65535; if (x == 0) wide = 0;"
    " wide -= 32768;",
    True: "const int size = x < 0 ? -x : x; int wide = size >= f[2] ? 32767 : size + f[1]; if (size == 0) wide = 0;"
    " if (x < 0) wide = -wide;",
}
