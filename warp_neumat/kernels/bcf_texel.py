"""C++ that fetches single texels from each storage of a feature texture, for the loops of :mod:`~.filter`.

Names inside: ``tx`` stored texels; ``fac``, ``region``, ``facts``, ``anchor``, ``modes``, ``ends``, ``mode_rows``,
``loose``, ``nibbles``: the parts of :func:`warp_neumat.kernels.bcf_storage.packed_tables`.
"""

from warp_neumat.kernels.bcf_storage import LOOSE, MODE_BYTES, NIBBLES


def vector_fetch(storage: str, signed: bool) -> str:
    """Return C++ of what ``filter.vector_code`` asks for, on a CPU with AVX2, F16C and BMI2."""
    per_block, byte = _NUMBERS[storage]
    head = f"const int PER_BLOCK = {per_block};"
    head += f"auto place = [&](int i) {{ return tx + {byte}; }};"
    if storage in _VECTOR:
        return head + _VECTOR[storage]
    texels = _TEXELS.replace("FINISH", _FINISH[signed])
    if storage == "unquantised":
        texels = texels.replace("NUMBER", "from.at[side][k][i]")
        return head + "const unsigned char* const stored = tx; auto prepare = [](const Taps&) {};" + texels
    decode = _DECODE.replace("WIDEN", _WIDEN[signed]).replace("ROW_BYTES", str(MODE_BYTES))
    decode = decode.replace("LOOSE_BYTES", str(512 * LOOSE)).replace("LOOSE_GROUPS", str(LOOSE))
    return head + decode + _LISTED + texels.replace("NUMBER", "found[side][k][i]")


def scalar_fetch(storage: str, signed: bool) -> str:
    """Return plain C++ of ``fetch`` for one texel."""
    if storage in _SCALAR_FETCH:
        return _SCALAR_FETCH[storage]
    texel = _SCALAR_TEXEL.replace("FINISH", _SCALAR_FINISH[signed])
    if storage == "unquantised":
        return texel + _SCALAR_UNQUANTISED
    return texel + _SCALAR_BLOCKS.replace("WIDEN", _SCALAR_WIDEN[signed]).replace("NIBBLES", str(NIBBLES))


# ---- vectors -----------------------------------------------------------------------------------------------------

_HALF = """
auto COLUMN = [](I x) { return (x & 3) * 3; };
auto ROW = [](I y) { return (y & 3) * 16 - (y & 1); };
auto prepare = [](const Taps&) {};
auto rows = [&](const Taps& from, int side, int i, V& upper, V& lower) __attribute__((always_inline)) {
    upper = __builtin_convertvector(*(const H8*)place(from.at[side][0][i]), V);
    lower = __builtin_convertvector(*(const H8*)place(from.at[side][1][i]), V);
};
"""

_RGBA8 = """
auto COLUMN = [](I x) { return x & 3; };
auto ROW = [](I y) { return (y & 3) * 4; };
auto prepare = [](const Taps&) {};
auto rows = [&](const Taps& from, int side, int i, V& upper, V& lower) __attribute__((always_inline)) {
    typedef unsigned int P __attribute__((vector_size(8)));
    auto at = [&](int k) { return *(const u32*)place(from.at[side][k][i]); };
    const P u = {at(0), at(1)}, l = {at(2), at(3)};
    upper = __builtin_convertvector((B8)u, V) * (1.0f / 255.0f);
    lower = __builtin_convertvector((B8)l, V) * (1.0f / 255.0f);
};
"""

# Blocks to 64 bytes as in the storage ``unquantised``; ``bcf_storage.mode_tables`` says what a row holds. Each of two
# loops is a shorter chain of dependent steps than both together, so that a core works on more blocks at a time.
_DECODE = """
auto decode = [&](const int* blocks, int count, unsigned char* out) __attribute__((always_inline)) {
    int row_at[64]; unsigned extra[64];
    _Pragma("clang loop unroll(disable)")
    for (int k = 0; k < count; ++k) {
        const unsigned char* const p = tx + 16ll * blocks[k];
        const unsigned long long lo = *(const u64*)p, hi = *(const u64*)(p + 8);
        const int mode = modes[lo & 31];
        const unsigned char* const row = mode_rows + ROW_BYTES * mode;
        row_at[k] = mode;
        extra[k] = __builtin_ia32_pext_di(lo, *(const u64*)(row + 352))
                 | __builtin_ia32_pext_di(hi, *(const u64*)(row + 360)) << *(const int*)(row + 368);
        const int part = (((int)(hi >> 13) & *(const int*)(row + 376)) | *(const int*)(row + 380)) * 2;
        const unsigned long long n = __builtin_ia32_pdep_di(hi >> *(const int*)(row + 372), nibbles[part])
                                   | nibbles[part + 1];
        const L2 both = {(long long)(n & 0x0F0F0F0F0F0F0F0Full), (long long)(n >> 4 & 0x0F0F0F0F0F0F0F0Full)};
        C16 c = (C16)both;
        c = __builtin_shufflevector(c, c, 0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
        const C16 w = __builtin_ia32_pshufb128(*(const C16*)(row + 320), c);
        C16 e = __builtin_ia32_pshufb128(*(const C16*)(row + 336), c);
        e += (C16){32, 30, 28, 26, 24, 22, 20, 18, 16, 14, 12, 10, 8, 6, 4, 2};
        C16* const codes = (C16*)(out + 64 * k + 32);
        codes[0] = __builtin_shufflevector(w, e, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
        codes[1] = __builtin_shufflevector(w, e, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    }
    __asm__ volatile("" ::: "memory");
    _Pragma("clang loop unroll(disable)")
    for (int k = 0; k < count; ++k) {
        const L2 block = *(const L2*)(tx + 16ll * blocks[k]);
        const C32 twice = (C32)__builtin_shufflevector(block, block, 0, 1, 0, 1);
        const unsigned char* const row = mode_rows + ROW_BYTES * row_at[k];
        const unsigned char* const more = (const unsigned char*)loose + LOOSE_BYTES * row_at[k];
        auto at = [&](int byte) __attribute__((always_inline)) { return *(const I*)(row + byte); };
        const I even = (I)__builtin_ia32_pshufb256(twice, (C32)at(0)) << at(64) >> at(128);
        const I odd = (I)__builtin_ia32_pshufb256(twice, (C32)at(32)) << at(96) >> at(160);
        S16 x = __builtin_shufflevector((S16)even, (S16)odd, 0, 17, 2, 19, 4, 21, 6, 23, 8, 25, 10, 27, 12, 29, 14, 31);
        x &= (S16)at(192);
        _Pragma("clang loop unroll(full)")
        for (int g = 0; g < LOOSE_GROUPS; ++g) x ^= *(const S16*)(more + 512 * g + 32 * (extra[k] >> 4 * g & 15));
        const L4 first = __builtin_shufflevector((L4)x, (L4)x, 0, 1, 0, 1);
        x += (S16)__builtin_ia32_pshufb256((C32)first, (C32)at(288));
        const S16 rounding = (S16)at(224), largest = (S16)at(256);
        WIDEN
        *(S16*)(out + 64 * k) = x;
    }
};
"""

# Blocks of a group of lanes are decoded into places of ``stored``, one after another, and texels numbered anew. At
# random places each footprint lists its 1, 2 or 4 blocks without a jump that could be mispredicted. Where neighbouring
# lanes read the same block, blocks are looked up among those decoded since the places were last begun anew.
_LISTED = """
alignas(64) unsigned char stored[64 * 128];
int held[128 + 4], next = 0, found[2][4][8];
unsigned char guess[64];
memset(guess, 0, 64);
auto look_up = [&](int block) __attribute__((always_inline)) {
    const unsigned hash = (unsigned)block * 0x9E3779B1u >> 26;
    int place = guess[hash];
    if (place >= next || held[place] != block) {
        place = next++;
        guess[hash] = (unsigned char)place;
        held[place] = block;
    }
    return place;
};
auto prepare = [&](const Taps& from) __attribute__((always_inline)) {
    if (next > 64) next = 0;
    const int begin = next;
    for (int side = 0; side < from.sides; ++side) {
        I at[4], block[4];
        for (int k = 0; k < 4; ++k) { at[k] = *(const I*)from.at[side][k]; block[k] = at[k] >> 6; }
        const I beside = __builtin_shufflevector(block[0], block[0], 1, 2, 3, 4, 5, 6, 7, 7);
        if (__builtin_popcount(__builtin_ia32_movmskps256((V)(block[0] == beside))) > 3) {
            for (int i = 0; i < 8; ++i) for (int k = 0; k < 4; ++k) {
                const int number = from.at[side][k][i];
                found[side][k][i] = look_up(number >> 6) * 64 + (number & 63);
            }
        } else {
            // Each footprint writes (upper left, upper right) and (lower left, lower right) where they belong; what is
            // written twice is overwritten by the next one.
            const I wide = (block[0] != block[1]) & 1, high = (block[0] != block[2]) & (wide + 1);
            const I own = wide + high + 1, zero = {};
            I sum = own;
            sum += __builtin_shufflevector(sum, zero, 8, 0, 1, 2, 3, 4, 5, 6);
            sum += __builtin_shufflevector(sum, zero, 8, 8, 0, 1, 2, 3, 4, 5);
            sum += __builtin_shufflevector(sum, zero, 8, 8, 8, 8, 0, 1, 2, 3);
            const I first = sum - own + next, below = first + high;
            next += sum[7];
            *(I*)found[side][0] = first << 6 | (at[0] & 63); *(I*)found[side][1] = first + wide << 6 | (at[1] & 63);
            *(I*)found[side][2] = below << 6 | (at[2] & 63); *(I*)found[side][3] = below + wide << 6 | (at[3] & 63);
            int place[2][8], pairs[2][16];
            *(I*)place[0] = first; *(I*)place[1] = below;
            for (int row = 0; row < 2; ++row) {
                const I l = block[2 * row], r = block[2 * row + 1];
                *(I*)pairs[row] = __builtin_shufflevector(l, r, 0, 8, 1, 9, 4, 12, 5, 13);
                *(I*)(pairs[row] + 8) = __builtin_shufflevector(l, r, 2, 10, 3, 11, 6, 14, 7, 15);
            }
            __asm__ volatile("" ::: "memory");
            _Pragma("clang loop unroll(full)")
            for (int i = 0; i < 8; ++i) {
                const int spot = (i & 1) | (i & 2) << 1 | (i & 4) >> 1;
                *(u64*)(held + place[0][i]) = *(const u64*)(pairs[0] + 2 * spot);
                *(u64*)(held + place[1][i]) = *(const u64*)(pairs[1] + 2 * spot);
            }
        }
    }
    decode(held + begin, next - begin, stored + 64 * begin);
};
"""

_WIDEN = {
    False: """
    const S16 wide = x + rounding, full = x == largest;
    x = ((wide | full) & (x != 0)) ^ (short)-32768;
""",
    True: """
    const S16 sign = x >> 15, size = (x ^ sign) - sign;
    const S16 wide = size >= largest ? (S16){} + (short)0x7FFF : size + rounding;
    x = ((wide & (size != 0)) ^ sign) - sign;
""",
}

# A texel is 2 bytes behind the endpoints of its block: which weights, and how far on from 32 bytes before it the
# endpoints are.
_TEXELS = """
auto COLUMN = [](I x) { return (x & 3) * 2; };
auto ROW = [](I y) { return (y & 3) * 8; };
auto rows = [&](const Taps& from, int side, int i, V& upper, V& lower) __attribute__((always_inline)) {
    S8 e[4], w[4];
    _Pragma("clang loop unroll(full)")
    for (int k = 0; k < 4; ++k) {
        const int at = NUMBER;
        const unsigned char* const p = stored + at;
        e[k] = *(const S8*)(p - 32 + p[33]);
        w[k] = *(const S8*)((const char*)fac + 8 * p[32]);
    }
#define BCF_JOIN(a, b) __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
    I u = (I)__builtin_ia32_pmaddwd256(BCF_JOIN(e[0], e[2]), BCF_JOIN(w[0], w[2]));
    I l = (I)__builtin_ia32_pmaddwd256(BCF_JOIN(e[1], e[3]), BCF_JOIN(w[1], w[3]));
    FINISH
    upper = __builtin_convertvector((H8)__builtin_shufflevector(h, h, 0, 1, 2, 3, 4, 5, 6, 7), V);
    lower = __builtin_convertvector((H8)__builtin_shufflevector(h, h, 8, 9, 10, 11, 12, 13, 14, 15), V);
};
"""

# The registers hold (upper left, lower left) and (upper right, lower right); packing both gives rows.
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
    "half": (64, "2ll * i"),
    "rgba8": (16, "4ll * i"),
    "unquantised": (64, "i"),
    "blocks": (64, "(i >> 6) * 16ll"),
}
"""How the vector form numbers texels: PER_BLOCK, and the byte at which what is read for number i begins."""

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
    const unsigned char* p = tx + 128ll * (i >> 4) + 32 * (i >> 2 & 3) - 2 * (i >> 2 & 1) + 2 + 6 * (i & 3);
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
    blend((const short*)(p + 2 * t - 32 + p[33 + 2 * t]), (const short*)((const char*)fac + 8 * p[32 + 2 * t]), rgb);
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
    blend(pair, (const short*)(fac + 4 * (q + 8 * f[3])), rgb);
};
"""

_SCALAR_WIDEN = {
    False: "int wide = (unsigned short)x + f[1]; if (x == (short)f[2]) wide = 65535; if (x == 0) wide = 0;"
    " wide -= 32768;",
    True: "const int size = x < 0 ? -x : x; int wide = size >= f[2] ? 32767 : size + f[1]; if (size == 0) wide = 0;"
    " if (x < 0) wide = -wide;",
}
