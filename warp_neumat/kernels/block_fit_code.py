"""C++ of the search for the endpoints of BC4 and BC7 blocks, for as many blocks at once as a register has lanes.

Nothing branches on a block's content, except to stop when no lane gains any more. Each text defines a local class for a
``wp.func_native`` snippet, behind the text of :func:`~warp_neumat.kernels.block_pack.pack_code`, whose numbers it uses;
on CUDA a register holds one block. :data:`LANES` comes first; ``block_fit_cluster``, the search of BC1, has it too.

BC4: for either palette from the least and the greatest value, without those near 0 and 255 for the ramp of six: least
squares, then steps of both endpoints, a few of them large. BC7: from the ends of the principal axis, least squares for
each choice of lowest bits, then steps by one code.
"""

LANES = r"""
struct Lanes : Pack {
    static CUDA_CALLABLE F most(F a, F b) { return a > b ? a : b; }
    static CUDA_CALLABLE F least(F a, F b) { return a < b ? a : b; }
    static CUDA_CALLABLE F clamp(F x, float top) { return least(most(x, zero()), zero() + top); }
    static CUDA_CALLABLE F nearest_whole(F x) { return real(whole(x + 0.5f)); }    // of x >= 0
    static CUDA_CALLABLE bool any(I mask) {
        int all = 0;
        for (int l = 0; l < NV; ++l) all |= ((const int*)&mask)[l];
        return all != 0;
    }
    static CUDA_CALLABLE float& lane(F& x, int l) { return ((float*)&x)[l]; }
    // Axis of largest spread of the texels x[C·t + c] about 0, unit in its largest number.
    static CUDA_CALLABLE void principal(const F* x, F* axis) {
        F m[C][C];
        for (int a = 0; a < C; ++a)
            for (int b = 0; b <= a; ++b) {
                F s = zero();
                for (int t = 0; t < 16; ++t) s += x[C * t + a] * x[C * t + b];
                m[a][b] = s; m[b][a] = s;
            }
        // Start from the row of the largest variance: it is not orthogonal to the axis.
        F top = zero() - 1.0f;
        for (int a = 0; a < C; ++a) {
            for (int b = 0; b < C; ++b) axis[b] = m[a][a] > top ? m[a][b] : axis[b];
            top = most(top, m[a][a]);
        }
        for (int n = 0; n < 6; ++n) {
            F next[C], size = zero() + 1e-30f;
            for (int a = 0; a < C; ++a) {
                next[a] = zero();
                for (int b = 0; b < C; ++b) next[a] += m[a][b] * axis[b];
                size = most(size, most(next[a], -next[a]));
            }
            for (int a = 0; a < C; ++a) axis[a] = next[a] / size;
        }
    }
};
"""

BC4 = r"""
struct FitBC4 : Lanes {
    F x[16], low, high, error;    // values and endpoints [byte]

    // Error of the decoded values: the ramp from a to b in sevenths, or in fifths with 0 and 255. They lie 0, 1/7 ...
    // 6/7 below the real ramp: places are sought that much higher in the mean, which seldom misses the best.
    CUDA_CALLABLE F measure(F a, F b, int parts) const {
        const F scale = (float)parts / most(b - a, zero() + 1.0f), step = (b - a) * (1.0f / (float)parts);
        const F from = 0.5f + (0.4f - a) * scale, base = a + 0.01f;
        F total = zero();
        for (int t = 0; t < 16; ++t) {
            const F n = real(whole(clamp(x[t] * scale + from, (float)parts + 0.5f)));
            F d = x[t] - real(whole(n * step + base));
            d = d * d;
            if (parts == 5) { const F e = 255.0f - x[t]; d = least(d, least(x[t] * x[t], e * e)); }
            total += d;
        }
        return total;
    }

    CUDA_CALLABLE I keep(F a, F b, int parts) {
        const F e = measure(a, b, parts);
        const I better = e < error;
        error = better ? e : error; low = better ? a : low; high = better ? b : high;
        return better;
    }

    // From a pair on: least squares for the nearest places, then steps of both.
    CUDA_CALLABLE void descend(F a, F b, int parts, int rounds) {
        const F outer_error = error, outer_low = low, outer_high = high;
        error = zero() + 3e38f;
        keep(a, b, parts);
        for (int n = 0; n < 2; ++n) {
            const F scale = (float)parts / most(high - low, zero() + 1.0f), inverse = zero() + 1.0f / (float)parts;
            F count = zero(), w1 = count, w2 = count, s = count, v = count;
            for (int t = 0; t < 16; ++t) {
                const F w = nearest_whole(clamp((x[t] - low) * scale, (float)parts)) * inverse;
                F on = zero() + 1.0f;    // 0 for what 0 or 255 is nearer to
                if (parts == 5) on = ((x[t] < 0.5f * low) | (x[t] > 0.5f * high + 127.5f)) ? zero() : on;
                count += on; w1 += on * w; w2 += on * w * w; s += on * x[t]; v += on * w * x[t];
            }
            const F det = count * w2 - w1 * w1;
            const I good = det > zero() + 1e-3f;
            const F under = good ? 1.0f / det : zero();
            const F p = (s * w2 - v * w1) * under, q = (v * count - s * w1) * under;
            a = nearest_whole(clamp(p, 255.0f)); b = nearest_whole(clamp(q, 255.0f));
            keep(good ? a : low, good ? b : high, parts);
        }
        for (int n = 0; n < rounds; ++n) {
            const float step = n == 2 ? 6.0f : n == 3 ? 3.0f : n == 4 ? 2.0f : 1.0f;    // large ones out of hollows
            I gained = {};
            for (int move = 0; move < 8; ++move) {
                const int which = move + (move > 3);
                a = clamp(low + step * (float)(which % 3 - 1), 255.0f);
                b = clamp(high + step * (float)(which / 3 - 1), 255.0f);
                gained = gained | keep(least(a, b), most(a, b), parts);
            }
            if (n > 4 && !any(gained)) break;
        }
        const I worse = outer_error < error;
        error = worse ? outer_error : error; low = worse ? outer_low : low; high = worse ? outer_high : high;
    }

    CUDA_CALLABLE void solve(int rounds) {
        F least_all = x[0], most_all = x[0], inner_low = zero() + 255.0f, inner_high = zero();
        for (int t = 0; t < 16; ++t) {
            least_all = least(least_all, x[t]); most_all = most(most_all, x[t]);
            inner_low = x[t] > 4.0f ? least(inner_low, x[t]) : inner_low;
            inner_high = x[t] < 251.0f ? most(inner_high, x[t]) : inner_high;
        }
        error = zero() + 3e38f; low = zero(); high = zero();
        descend(nearest_whole(least_all), nearest_whole(most_all), 7, rounds);
        const F a = nearest_whole(inner_low), b = nearest_whole(inner_high);
        descend(least(a, b), most(a, b), 5, rounds);
    }
};
"""

BC7 = r"""
struct FitBC7 : Lanes {
    F x[16 * C], mean[C], spread, code[2 * C], error;    // texels about the mean, and the best endpoints [byte]
    I opaque;                                            // where alpha is 255 throughout
    const float *G, *R;

    CUDA_CALLABLE F squared(const F* d) const {
        F s = zero();
        for (int c = 0; c < C; ++c) for (int k = 0; k < C; ++k) s += G[4 * c + k] * d[c] * d[k];
        return s;
    }

    CUDA_CALLABLE void prepare() {
        opaque = zero() == zero();
        if (C == 4) for (int t = 0; t < 16; ++t) opaque = opaque & (x[C * t + C - 1] >= zero() + 254.5f);
        for (int c = 0; c < C; ++c) {
            F s = zero();
            for (int t = 0; t < 16; ++t) s += x[C * t + c];
            mean[c] = s * 0.0625f;
            for (int t = 0; t < 16; ++t) x[C * t + c] -= mean[c];
        }
        spread = zero();
        for (int t = 0; t < 16; ++t) spread += squared(x + C * t);
        error = zero() + 3e38f;
        for (int k = 0; k < 2 * C; ++k) code[k] = zero() + 1.0f;
    }

    // The line between endpoints k: Gd for their difference d, its product with the first end, d·Gd, what turns a
    // texel's product into its place 0 ... 15, and the squared distance of the mean to the first end.
    struct Line { F along[C], back, size, scale, rest; };
    CUDA_CALLABLE Line line(const F* k) const {
        Line l;
        F o[C], d[C];
        for (int c = 0; c < C; ++c) { o[c] = k[c] - mean[c]; d[c] = k[C + c] - k[c]; }
        l.back = zero(); l.size = zero();
        for (int c = 0; c < C; ++c) {
            l.along[c] = zero();
            for (int e = 0; e < C; ++e) l.along[c] += G[4 * c + e] * d[e];
            l.size += l.along[c] * d[c]; l.back += l.along[c] * o[c];
        }
        l.scale = l.size > zero() ? 15.0f / most(l.size, zero() + 1e-30f) : zero();
        l.rest = squared(o);
        return l;
    }
    CUDA_CALLABLE F weight(const Line& l, F product) const {
        const I n = whole(clamp(product * l.scale, 15.0f) + 0.5f);
        return real((n * 273 + 32) >> 6) * 0.015625f;
    }
    CUDA_CALLABLE F product(const Line& l, int t) const {
        F s = -l.back;
        for (int c = 0; c < C; ++c) s += x[C * t + c] * l.along[c];
        return s;
    }

    // Takes endpoints k where their error, but for the rounding of what lies between them, is less.
    CUDA_CALLABLE I keep(F* k) {
        if (C == 4) for (int c = C - 1; c < 2 * C; c += C) k[c] = opaque ? zero() + 255.0f : k[c];
        const Line l = line(k);
        F e = spread + 16.0f * l.rest;
        for (int t = 0; t < 16; ++t) {
            const F s = product(l, t), w = weight(l, s);
            e += w * (w * l.size - 2.0f * s);
        }
        const I better = e < error;
        error = better ? e : error;
        for (int c = 0; c < 2 * C; ++c) code[c] = better ? k[c] : code[c];
        return better;
    }

    // The nearest code with lowest bit p.
    static CUDA_CALLABLE F rounded(F v, F p) { return 2.0f * nearest_whole(clamp((v - p) * 0.5f, 127.0f)) + p; }

    CUDA_CALLABLE void keep_rounded(const F* a, const F* b) {
        const F one = zero() + 1.0f;
        for (int p = C == 3 ? 3 : 0; p < 4; ++p) {
            const F pa = opaque ? one : zero() + (float)(p & 1), pb = opaque ? one : zero() + (float)(p >> 1);
            F k[2 * C];
            for (int c = 0; c < C; ++c) { k[c] = rounded(a[c], pa); k[C + c] = rounded(b[c], pb); }
            keep(k);
        }
    }

    // Ends of the line through the texels.
    CUDA_CALLABLE void start() {
        F y[16 * C], axis[C], a[C], b[C], low = zero(), high = zero(), ss = zero(), sx[C];
        for (int t = 0; t < 16; ++t)
            for (int c = 0; c < C; ++c) {
                y[C * t + c] = zero();
                for (int k = 0; k < C; ++k) y[C * t + c] += R[4 * c + k] * x[C * t + k];
            }
        principal(y, axis);
        for (int c = 0; c < C; ++c) sx[c] = zero();
        for (int t = 0; t < 16; ++t) {
            F s = zero();
            for (int c = 0; c < C; ++c) s += y[C * t + c] * axis[c];
            low = least(low, s); high = most(high, s); ss += s * s;
            for (int c = 0; c < C; ++c) sx[c] += s * x[C * t + c];
        }
        for (int c = 0; c < C; ++c) {
            const F slope = ss > zero() ? sx[c] / most(ss, zero() + 1e-30f) : zero();
            a[c] = mean[c] + low * slope; b[c] = mean[c] + high * slope;
        }
        keep_rounded(a, b);
    }

    // Least squares for the indices of the best codes.
    CUDA_CALLABLE void refine() {
        const Line l = line(code);
        F w1 = zero(), w2 = zero(), v[C], a[C], b[C];
        for (int c = 0; c < C; ++c) v[c] = zero();
        for (int t = 0; t < 16; ++t) {
            const F w = weight(l, product(l, t));
            w1 += w; w2 += w * w;
            for (int c = 0; c < C; ++c) v[c] += w * x[C * t + c];
        }
        const F det = 16.0f * w2 - w1 * w1, inverse = det > zero() + 1e-3f ? 1.0f / det : zero();
        for (int c = 0; c < C; ++c) {
            a[c] = mean[c] - v[c] * w1 * inverse; b[c] = mean[c] + v[c] * (16.0f - w1) * inverse;
        }
        keep_rounded(a, b);
    }

    // Steps of two, in one channel or in all, and with four channels of one in all channels of an end.
    CUDA_CALLABLE void nudge(int rounds) {
        const int moves = 8 * (C + 1) + (C == 4 ? 4 : 0);
        for (int n = 0; n < rounds; ++n) {
            I gained = {};
            for (int move = 0; move < moves; ++move) {
                const bool odd = move >= 8 * (C + 1);
                const int channel = move / 8, which = odd ? 1 + 2 * (move & 3) : move % 8 + (move % 8 > 3);
                F k[2 * C];
                for (int end = 0; end < 2; ++end) {
                    const float step = (float)((end ? which / 3 : which % 3) - 1);
                    F p = code[end * C] - 2.0f * real(whole(code[end * C] * 0.5f));
                    F by = zero() + (odd ? step : 2.0f * step);
                    if (odd) { by = opaque ? zero() : by; if (step != 0.0f) p = opaque ? p : 1.0f - p; }
                    for (int c = 0; c < C; ++c) {
                        const F to = odd || channel == c || channel == C ? code[end * C + c] + by : code[end * C + c];
                        k[end * C + c] = least(most(to, p), p + 254.0f);
                    }
                }
                gained = gained | keep(k);
            }
            if (!any(gained)) return;
        }
    }

    CUDA_CALLABLE void solve(const float* metric, int rounds) {
        G = metric; R = metric + 16;
        prepare();
        start();
        refine();
        nudge(rounds);
    }
};
"""
