"""C++ that writes BC1, BC4 and BC7 blocks from two endpoints and sixteen colours, for ``wp.func_native`` snippets.

:func:`pack_code` returns the text of a local class; the snippet that begins with it may call

- ``Pack::write_bc1(e0, e1, colours, G, out8)``: always four colours (c0 > c1), so that no block of an opaque texture
  falls into the punch-through mode;
- ``Pack::write_bc4(e0, e1, colours, out8)``: whichever palette is closer, the ramp of eight or the ramp of six with 0
  and 255;
- ``Pack::write_bc7(e0, e1, colours, channels, G, out16)``: mode 6; three channels leave alpha at 255.

All numbers are in [0, 1]: what lies outside is clamped, and NaN counts as 0. Colours are planar, [channel][16], texel
t = 4·y + x; no pointer needs more than its type's alignment. ``G`` is the symmetric metric of squared differences
δᵀGδ, float[16], 4 × 4 row-major, of which the upper left channels × channels numbers count. Each texel gets the palette
entry nearest to its colour in that metric: of the real palette in BC1 (``kernels/bc1.py`` rounds it to bytes), of the
decoded bytes in BC4 and BC7, whose decoders agree on every bit. All return the squared error to these entries, summed
over texels. Formats: see ``kernels/bc1.py``, ``bc4.py`` and ``bc7.py``; NumPy twin: ``reference/block_fit.py``.

A register holds texels of one block; on CUDA, where a thread writes a block, it holds one texel.
"""

_PACK = r"""
struct Pack {
#if defined(__CUDA_ARCH__)
    typedef float F, LooseF; typedef int I, LooseI; enum { NV = 1 };
    static CUDA_CALLABLE I whole(F x) { return (int)x; }
    static CUDA_CALLABLE F real(I x) { return (float)x; }
#else
#if defined(__AVX512F__)
    enum { NV = 16 };
#elif defined(__AVX__)
    enum { NV = 8 };
#else
    enum { NV = 4 };
#endif
    typedef float F __attribute__((vector_size(4 * NV)));
    typedef int I __attribute__((vector_size(4 * NV)));
    typedef float LooseF __attribute__((vector_size(4 * NV), aligned(4), may_alias));    // for what lies anywhere
    typedef int LooseI __attribute__((vector_size(4 * NV), aligned(4), may_alias));
    static I whole(F x) { return __builtin_convertvector(x, I); }
    static F real(I x) { return __builtin_convertvector(x, F); }
#endif
    static CUDA_CALLABLE F zero() { F z = {}; return z; }
    static CUDA_CALLABLE float total(F x) {
        float s = 0.0f;
        for (int l = 0; l < NV; ++l) s += ((float*)&x)[l];
        return s;
    }
    // The comparisons are false for NaN, which so becomes 0.
    static CUDA_CALLABLE float unit(float x) { return x > 0.0f ? (x < 1.0f ? x : 1.0f) : 0.0f; }
    static CUDA_CALLABLE F texels(const float* x) {
        F v = *(const LooseF*)x; v = v > zero() ? v : zero(); return v < zero() + 1.0f ? v : zero() + 1.0f;
    }
    static CUDA_CALLABLE int code(float x, int most) { return (int)(unit(x) * (float)most + 0.5f); }

    static CUDA_CALLABLE void store(unsigned char* out, unsigned long long word) {
        for (int k = 0; k < 8; ++k) out[k] = (unsigned char)(word >> (8 * k));
    }
    static CUDA_CALLABLE unsigned long long join(const int* index, int bits, int first, int last) {
        unsigned long long word = 0;
        for (int t = first; t < last; ++t) word |= (unsigned long long)index[t] << (bits * (t - first));
        return word;
    }

    static CUDA_CALLABLE float write_bc1(const float* e0, const float* e1, const float* colours, const float* G,
                                         unsigned char* out8) {
        const int a = code(e0[0], 31) << 11 | code(e0[1], 63) << 5 | code(e0[2], 31);
        const int b = code(e1[0], 31) << 11 | code(e1[1], 63) << 5 | code(e1[2], 31);
        int high = a > b ? a : b, low = a > b ? b : a;
        if (high == low) { if (low & 31) --low; else ++high; }    // one step of blue apart
        return index_bc1(high, low, colours, G, out8);
    }

    // The block of 565 endpoints high > low.
    static CUDA_CALLABLE float index_bc1(int high, int low, const float* colours, const float* G, unsigned char* out8) {
        const float o[3] = {(high >> 11) * (1.0f / 31), (high >> 5 & 63) * (1.0f / 63), (high & 31) * (1.0f / 31)};
        const float d[3] = {((low >> 11) - (high >> 11)) * (1.0f / 93),
                            ((low >> 5 & 63) - (high >> 5 & 63)) * (1.0f / 189),
                            ((low & 31) - (high & 31)) * (1.0f / 93)};
        // Entry n of the line is o + n·d; n is nearer than n - 1 where x·Gd > (n - 1/2) d·Gd, x counted from o.
        float along[3], step = 0.0f;
        for (int c = 0; c < 3; ++c) {
            along[c] = G[4 * c] * d[0] + G[4 * c + 1] * d[1] + G[4 * c + 2] * d[2];
            step += along[c] * d[c];
        }
        int index[16];
        F error = zero();
        for (int t = 0; t < 16; t += NV) {
            F x = texels(colours + t) - o[0], y = texels(colours + 16 + t) - o[1], z = texels(colours + 32 + t) - o[2];
            const F s = x * along[0] + y * along[1] + z * along[2], none = zero(), one = none + 1.0f;
            const F m1 = s > none + 0.5f * step ? one : none, m2 = s > none + 1.5f * step ? one : none,
                    m3 = s > none + 2.5f * step ? one : none, n = m1 + m2 + m3;
            *(LooseI*)(index + t) = whole(2.0f * m1 + m2 - 2.0f * m3);    // 0, 2, 3, 1 along the line
            x -= n * d[0]; y -= n * d[1]; z -= n * d[2];
            error += x * (G[0] * x + G[1] * y + G[2] * z) + y * (G[4] * x + G[5] * y + G[6] * z)
                   + z * (G[8] * x + G[9] * y + G[10] * z);
        }
        store(out8, (unsigned)high | (unsigned)low << 16 | join(index, 2, 0, 16) << 32);
        return total(error);
    }

    // Places 0 … 7 of the nearest of eight rising values [byte], and the squared error.
    static CUDA_CALLABLE float nearest(const float* values, const F* x, int* place) {
        F error = zero();
        for (int t = 0; t < 16; t += NV) {
            const F p = x[t / NV];
            F v = zero() + values[0], n = zero();
            for (int k = 1; k < 8; ++k) {
                const F middle = zero() + 0.5f * (values[k - 1] + values[k]);
                v = p > middle ? zero() + values[k] : v; n = p > middle ? zero() + (float)k : n;
            }
            *(LooseI*)(place + t) = whole(n);
            error += (p - v) * (p - v);
        }
        return total(error) * (1.0f / 65025);
    }

    static CUDA_CALLABLE float write_bc4(float e0, float e1, const float* colours, unsigned char* out8) {
        const int a = code(e0, 255), b = code(e1, 255), high = a > b ? a : b, low = a > b ? b : a;
        F x[16 / NV];
        for (int t = 0; t < 16; t += NV) x[t / NV] = texels(colours + t) * 255.0f;
        return index_bc4(high, low, x, out8);
    }

    // The block of endpoints high >= low for values x [byte], with the better palette.
    static CUDA_CALLABLE float index_bc4(int high, int low, const F* x, unsigned char* out8) {
        float values[8] = {0.0f, (float)low, 0.0f, 0.0f, 0.0f, 0.0f, (float)high, 255.0f};
        for (int k = 1; k < 5; ++k) values[k + 1] = (float)(((5 - k) * low + k * high) / 5);
        int place[16], eight[16];
        float error = nearest(values, x, place);
        int first = low, second = high;
        unsigned codes = 0x71543206u;    // index of each place
        if (high > low) {
            for (int k = 0; k < 8; ++k) values[k] = (float)(((7 - k) * low + k * high) / 7);
            const float other = nearest(values, x, eight);
            if (!(error < other)) {
                error = other; first = high; second = low; codes = 0x02345671u;
                for (int t = 0; t < 16; ++t) place[t] = eight[t];
            }
        }
        for (int t = 0; t < 16; ++t) place[t] = codes >> (4 * place[t]) & 7;
        store(out8, (unsigned)first | (unsigned)second << 8 | join(place, 3, 0, 16) << 16);
        return error;
    }

    // Sevens of bits of an endpoint for its lowest bit p; returns the squared error of the endpoint [byte].
    static CUDA_CALLABLE float round_bc7(const float* e, int p, const float* g, int* bits) {
        float d[4], s = 0.0f;
        for (int c = 0; c < 4; ++c) {
            const float x = e[c] * 255.0f;
            const int q = (int)(0.5f * (x - p) + 0.5f);    // x - p >= -1 truncates to 0
            bits[c] = q < 127 ? q : 127;
            d[c] = x - (2 * bits[c] + p);
        }
        for (int c = 0; c < 4; ++c) for (int k = 0; k < 4; ++k) s += g[4 * c + k] * d[c] * d[k];
        return s;
    }

    static CUDA_CALLABLE float write_bc7(const float* e0, const float* e1, const float* colours, int channels,
                                         const float* G, unsigned char* out16) {
        float g[16];
        for (int k = 0; k < 16; ++k) g[k] = (k & 3) < channels && (k >> 2) < channels ? G[k] : 0.0f;
        int bits[2][4], p[2];
        for (int k = 0; k < 2; ++k) {
            float e[4];
            for (int c = 0; c < 4; ++c) e[c] = c < channels ? unit((k ? e1 : e0)[c]) : 1.0f;
            int even[4];
            const float odd = round_bc7(e, 1, g, bits[k]);
            // An alpha of 255 is odd: opaque endpoints stay so.
            p[k] = e[3] * 255.0f >= 254.5f || !(round_bc7(e, 0, g, even) < odd);
            if (!p[k]) for (int c = 0; c < 4; ++c) bits[k][c] = even[c];
        }
        return index_bc7(bits[0], bits[1], p[0], p[1], colours, channels, g, out16);
    }

    // The block of endpoints of seven bits a channel and a lowest bit each; g has no number past the channels.
    static CUDA_CALLABLE float index_bc7(const int* a7, const int* b7, int pa, int pb, const float* colours,
                                         int channels, const float* g, unsigned char* out16) {
        int a[4], step[4];
        for (int c = 0; c < 4; ++c) { a[c] = 2 * a7[c] + pa; step[c] = 2 * b7[c] + pb - a[c]; }
        F x[4][16 / NV], low[16 / NV], at[16 / NV];    // colours [byte], counted from endpoint a
        for (int c = 0; c < 4; ++c)
            for (int t = 0; t < 16; t += NV)
                x[c][t / NV] = c < channels ? texels(colours + 16 * c + t) * 255.0f - (float)a[c] : zero();
        for (int k = 0; k < 16 / NV; ++k) { low[k] = zero(); at[k] = zero(); }
        for (int n = 1; n < 16; ++n) {    // entry 0 is endpoint a, of score 0
            const int w = (273 * n + 32) >> 6;
            float v[4], u[4], s = 0.0f;
            for (int c = 0; c < 4; ++c) v[c] = (float)((step[c] * w + 32) >> 6);
            for (int c = 0; c < 4; ++c) {
                u[c] = g[4 * c] * v[0] + g[4 * c + 1] * v[1] + g[4 * c + 2] * v[2] + g[4 * c + 3] * v[3];
                s += u[c] * v[c]; u[c] *= -2.0f;
            }
            for (int k = 0; k < 16 / NV; ++k) {
                const F e = x[0][k] * u[0] + x[1][k] * u[1] + x[2][k] * u[2] + x[3][k] * u[3] + s;
                at[k] = e < low[k] ? zero() + (float)n : at[k]; low[k] = e < low[k] ? e : low[k];
            }
        }
        int index[16];
        F error = zero();
        for (int k = 0; k < 16 / NV; ++k) {
            const I n = whole(at[k]), w = (273 * n + 32) >> 6;
            *(LooseI*)(index + k * NV) = n;
            F d[4];
            for (int c = 0; c < 4; ++c) d[c] = x[c][k] - real((step[c] * w + 32) >> 6);
            for (int c = 0; c < 4; ++c)
                error += d[c] * (g[4 * c] * d[0] + g[4 * c + 1] * d[1] + g[4 * c + 2] * d[2] + g[4 * c + 3] * d[3]);
        }
        const bool flip = index[0] > 7;    // texel 0 stores three bits
        if (flip) for (int t = 0; t < 16; ++t) index[t] = 15 - index[t];
        unsigned long long word = 64ull | (unsigned long long)(flip ? pb : pa) << 63;
        for (int c = 0; c < 4; ++c)
            word |= (unsigned long long)(flip ? b7[c] : a7[c]) << (7 + 14 * c)
                  | (unsigned long long)(flip ? a7[c] : b7[c]) << (14 + 14 * c);
        store(out16, word);
        store(out16 + 8, (unsigned)(flip ? pa : pb) | (unsigned)index[0] << 1 | join(index, 4, 1, 16) << 4);
        return total(error) * (1.0f / 65025);
    }
};
"""


def pack_code() -> str:
    """Return the C++ class ``Pack`` to put at the head of a ``wp.func_native`` snippet, for the CPU and CUDA."""
    return _PACK
