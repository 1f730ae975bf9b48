"""Numbers of the BC6H fit as C++ text: vectors of blocks, and a channel in the domains that the format passes through.

Domains of a channel, ``h`` being the bit pattern of a half as a number (signed blocks: with the sign of the value):

- *g*, in which the error is measured: ``h`` (relative precision, the usual one), or the linear value;
- *u*, the 16-bit integers between which the format interpolates: (h + ½)·64/31, the middle of what decodes to h;
  signed: (h ± ½)·32/31.

On a CPU ``F`` and ``I`` hold one variable of as many blocks as a register has lanes; with ``@LANES@`` = 1, which is
what CUDA runs, they are a plain float and int.
"""

NUMBERS = r"""
enum { SIGNED = @SIGNED@, LINEAR = @LINEAR@, WEIGHTED = @WEIGHTED@, ROWS = LINEAR + WEIGHTED };
#if @LANES@ == 1
enum { NV = 1 };
typedef float F; typedef int I;
#define BC6_F(x) (float)(x)
#define BC6_I(x) (int)(x)
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
#define BC6_F(x) __builtin_convertvector(x, F)
#define BC6_I(x) __builtin_convertvector(x, I)
#endif

// One copy of what is called from several places: half the seconds of compilation.
#define BC6_CALL CUDA_CALLABLE __attribute__((noinline))

struct Number {
    CUDA_CALLABLE static F zero() { F z = {}; return z; }
    CUDA_CALLABLE static I none() { I z = {}; return z; }
    CUDA_CALLABLE static F as_float(I x) { union { I i; F f; } v; v.i = x; return v.f; }
    CUDA_CALLABLE static I as_int(F x) { union { I i; F f; } v; v.f = x; return v.i; }
    CUDA_CALLABLE static F most(F a, F b) { return a > b ? a : b; }
    CUDA_CALLABLE static F least(F a, F b) { return a < b ? a : b; }
    CUDA_CALLABLE static I most(I a, I b) { return a > b ? a : b; }
    CUDA_CALLABLE static I least(I a, I b) { return a < b ? a : b; }
    CUDA_CALLABLE static F magnitude(F a) { return a < zero() ? -a : a; }
    CUDA_CALLABLE static I magnitude(I a) { return a < none() ? -a : a; }

    // Half bits of a value, with a fraction where no half has it: a half is a float with its exponent 112 less.
    CUDA_CALLABLE static F bits_of(F x) {
        F m = BC6_F(as_int(magnitude(x) * 1.925929944387236e-34f)) * 1.220703125e-4f;
        return x < zero() ? -m : m;
    }
    CUDA_CALLABLE static F value_of(I h) {
        F m = as_float(magnitude(h) << 13) * 5.192296858534828e33f;
        return h < none() ? -m : m;
    }
    CUDA_CALLABLE static F wide_of(F h) {
        if (!SIGNED) return (h + 0.5f) * (64.0f / 31.0f);
        F half = h > zero() ? zero() + 0.5f : h < zero() ? zero() - 0.5f : zero();
        return (h + half) * (32.0f / 31.0f);
    }
    CUDA_CALLABLE static F wide(F g) { return wide_of(LINEAR ? bits_of(g) : g); }
    CUDA_CALLABLE static F in_range(F g) {
        const float top = LINEAR ? 65504.0f : 31743.0f;
        F low = SIGNED ? zero() - top : zero();
        return least(most(g, low), zero() + top);
    }

    // Nearest code of a 16-bit value. The lowest and highest codes stand for the ends of the range.
    CUDA_CALLABLE static I quantise(F v, int precision) {
        const int bits = precision - SIGNED, top = (1 << bits) - 1;
        F s = most(SIGNED ? magnitude(v) : v, zero()) * ((1 << bits) / (SIGNED ? 32768.0f : 65536.0f));
        s = least(s, zero() + (top + 0.5f));
        I q = BC6_I(bits >= 15 ? s + 0.5f : s);
        if (bits < 15) {
            q = ((q == 0) & (s > 0.75f)) ? q + 1 : q;
            q = ((q == top) & (s < top + 0.25f)) ? q - 1 : q;
        }
        q = least(q, none() + top);
        return SIGNED ? (v < zero() ? -q : q) : q;
    }
    CUDA_CALLABLE static I unquantise(I code, int precision) {
        const int bits = precision - SIGNED, shift = 16 - SIGNED, top = (1 << bits) - 1;
        if (bits >= 15) return code;
        I m = magnitude(code);
        I v = ((m << shift) + (1 << (shift - 1))) >> bits;
        v = m >= top ? none() + ((1 << shift) - 1) : v;
        v = m == 0 ? none() : v;
        return SIGNED ? (code < none() ? -v : v) : v;
    }

    // Variance along the longest axis of moments s (weighted sums, not means), its direction, and the variance left.
    CUDA_CALLABLE static F spread(const F* s, int squarings, F* axis, F* left) {
        const float tiny = 1e-30f;
        F inv = s[0] > zero() ? 1.0f / most(s[0], zero() + tiny) : zero();
        F xx = s[4] - s[1] * s[1] * inv, xy = s[5] - s[1] * s[2] * inv, xz = s[6] - s[1] * s[3] * inv;
        F yy = s[7] - s[2] * s[2] * inv, yz = s[8] - s[2] * s[3] * inv, zz = s[9] - s[3] * s[3] * inv;
        xx = most(xx, zero()); yy = most(yy, zero()); zz = most(zz, zero());
        const F trace = xx + yy + zz;
        F k = 1.0f / (trace + tiny);
        const F a = xx * k, b = xy * k, c = xz * k, d = yy * k, e = yz * k, f = zz * k;
        F ma = a, mb = b, mc = c, md = d, me = e, mf = f;
        for (int n = 0; n < squarings; ++n) {    // powers of the matrix turn every row into the longest axis
            const F na = ma * ma + mb * mb + mc * mc, nb = ma * mb + mb * md + mc * me;
            const F nc = ma * mc + mb * me + mc * mf, nd = mb * mb + md * md + me * me;
            const F ne = mb * mc + md * me + me * mf, nf = mc * mc + me * me + mf * mf;
            k = 1.0f / (na + nd + nf + tiny);
            ma = na * k; mb = nb * k; mc = nc * k; md = nd * k; me = ne * k; mf = nf * k;
        }
        const I row1 = (md > ma) & (md >= mf), row2 = (mf > ma) & (mf > md);
        F x = row2 ? mc : row1 ? mb : ma, y = row2 ? me : row1 ? md : mb, z = row2 ? mf : row1 ? me : mc;
        const F length = x * x + y * y + z * z;
        const F along = x * x * a + y * y * d + z * z * f + 2.0f * (x * y * b + x * z * c + y * z * e);
        F lambda = length > zero() ? along / most(length, zero() + tiny) : zero();
        lambda = least(lambda, zero() + 1.0f) * trace;
        axis[0] = x; axis[1] = y; axis[2] = z;
        *left = trace - lambda;
        return lambda;
    }

    // Step of the value to the next half.
    CUDA_CALLABLE static F rise(F bits) {
        const I h = BC6_I(magnitude(bits));
        return value_of(h + 1) - value_of(h);
    }
    // Weight of a least-squares row in half bits that has the gradient of the squared difference of values: slope from
    // target to decoded times slope at the decoded; squared slope where they meet.
    CUDA_CALLABLE static F slope(F target, F decoded) {
        const F a = bits_of(target), b = bits_of(decoded);
        const I near = magnitude(b - a) < 1.0f;
        const F chord = near ? rise(a) : (decoded - target) / (near ? zero() + 1.0f : b - a);
        return chord * (near ? chord : rise(b)) * 1e9f;    // near 1 for values near 1: no sum vanishes or overflows
    }
};
"""
