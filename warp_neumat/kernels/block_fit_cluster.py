"""C++ of the search for the endpoints of BC1 blocks: a cluster fit over all lanes of a register.

The text defines a local class, behind :data:`~warp_neumat.kernels.block_fit_code.LANES`.

With the texels sorted along a line and their mean taken off, a choice of the first texels i ≤ j ≤ k of the palette's
entries 1, 2 and 3 determines the best real endpoints; they lessen the squared error by |U|²·16 / (9·det) where U = P(i)
+ P(j) + P(k), P(n) is the sum of the first n texels, and det the determinant of the normal equations, which depends on
i, j, k alone. So all 969 choices cost three additions and a square each. The sums also hold in the metric G = RᵀR, for
R·P. It is done along the principal axis, then along the line found. The best endpoints are rounded to 565, compared
with the line's first and last texel and with the pair of which a third gives the mean (which flat blocks want), refined
by least squares, and at last their codes are stepped by one as long as the error lessens.
"""

BC1 = r"""
struct FitBC1 : Lanes {
    F x[48], mean[3], spread, code[6], error;    // texels about the mean, their squared sizes, the best codes
    F sums[51], scaled[51];                      // of the first n texels of the line, and R times them
    const float *G, *R;

    static CUDA_CALLABLE float top(int c) { return c == 1 ? 63.0f : 31.0f; }
    CUDA_CALLABLE F squared(const F* d) const {
        F s = zero();
        for (int c = 0; c < 3; ++c) s += d[c] * (G[4 * c] * d[0] + G[4 * c + 1] * d[1] + G[4 * c + 2] * d[2]);
        return s;
    }

    CUDA_CALLABLE void scale(const F* v, F* to) const {
        for (int c = 0; c < 3; ++c) to[c] = R[4 * c] * v[0] + R[4 * c + 1] * v[1] + R[4 * c + 2] * v[2];
    }

    CUDA_CALLABLE void prepare() {
        for (int c = 0; c < 3; ++c) {
            F s = zero();
            for (int t = 0; t < 16; ++t) s += x[3 * t + c];
            mean[c] = s * 0.0625f;
            for (int t = 0; t < 16; ++t) x[3 * t + c] -= mean[c];
        }
        spread = zero();
        for (int t = 0; t < 16; ++t) spread += squared(x + 3 * t);
        error = zero() + 3e38f;
        for (int k = 0; k < 6; ++k) code[k] = zero();
    }

    // Error of the block of codes k; the squares are written out so that a texel costs the best of four products.
    CUDA_CALLABLE F measure(const F* k) const {
        F o[3], d[3], along[3], step = zero(), back = zero();
        for (int c = 0; c < 3; ++c) {
            d[c] = (k[3 + c] - k[c]) * (1.0f / (3.0f * top(c)));
            o[c] = k[c] * (1.0f / top(c)) - mean[c];
        }
        for (int c = 0; c < 3; ++c) {
            along[c] = G[4 * c] * d[0] + G[4 * c + 1] * d[1] + G[4 * c + 2] * d[2];
            step += along[c] * d[c]; back += along[c] * o[c]; along[c] *= -2.0f;
        }
        back = 2.0f * back + step;
        const F two = 2.0f * step, six = 6.0f * step;
        F total = spread + 16.0f * squared(o);
        for (int t = 0; t < 16; ++t) {
            // u = |d|² - 2 d·(x - o): entry n adds n·u + (n² - n)·|d|².
            const F u = x[3 * t] * along[0] + x[3 * t + 1] * along[1] + x[3 * t + 2] * along[2] + back;
            total += least(least(zero(), u), least(2.0f * u + two, 3.0f * u + six));
        }
        return total;
    }

    // Takes codes k where their error is less.
    CUDA_CALLABLE I keep(const F* k) {
        const F e = measure(k);
        const I better = e < error;
        error = better ? e : error;
        for (int c = 0; c < 6; ++c) code[c] = better ? k[c] : code[c];
        return better;
    }

    CUDA_CALLABLE void keep_rounded(const F* a, const F* b) {
        F k[6];
        for (int c = 0; c < 3; ++c) {
            k[c] = nearest_whole(clamp(a[c], 1.0f) * top(c)); k[3 + c] = nearest_whole(clamp(b[c], 1.0f) * top(c));
        }
        keep(k);
    }

    // The pair a third of which is the mean.
    CUDA_CALLABLE void keep_flat() {
        F k[6];
        for (int c = 0; c < 3; ++c) {
            const F v = clamp(mean[c], 1.0f) * top(c);
            k[c] = nearest_whole(v); k[3 + c] = nearest_whole(clamp(3.0f * v - 2.0f * k[c], top(c)));
        }
        keep(k);
    }

    static CUDA_CALLABLE void order(F* row, int i, int j) {
        F *a = row + 4 * i, *b = row + 4 * j;
        const I swap = a[3] > b[3];
        for (int c = 0; c < 4; ++c) { const F p = a[c], q = b[c]; a[c] = swap ? q : p; b[c] = swap ? p : q; }
    }

    // Sums of the texels in the order of their products with an axis. Batcher's odd-even merge sort.
    CUDA_CALLABLE void sort(const F* axis) {
        F row[64];
        for (int t = 0; t < 16; ++t) {
            row[4 * t + 3] = zero();
            for (int c = 0; c < 3; ++c) { row[4 * t + c] = x[3 * t + c]; row[4 * t + 3] += x[3 * t + c] * axis[c]; }
        }
        for (int p = 1; p < 16; p *= 2)
            for (int k = p; k >= 1; k /= 2)
                for (int j = k % p; j + k < 16; j += 2 * k)
                    for (int i = 0; i < k && i + j + k < 16; ++i)
                        if ((i + j) / (2 * p) == (i + j + k) / (2 * p)) order(row, i + j, i + j + k);
        for (int c = 0; c < 3; ++c) sums[c] = zero();
        for (int t = 0; t < 16; ++t) for (int c = 0; c < 3; ++c) sums[3 * t + 3 + c] = sums[3 * t + c] + row[4 * t + c];
        for (int t = 0; t < 17; ++t) scale(sums + 3 * t, scaled + 3 * t);
    }

    // The first and the last texel of the line: the best real endpoints of a block of few colours may leave the gamut.
    CUDA_CALLABLE void keep_extremes() {
        F a[3], b[3];
        for (int c = 0; c < 3; ++c) {
            a[c] = mean[c] + sums[3 + c]; b[c] = mean[c] + sums[48 + c] - sums[45 + c];
        }
        keep_rounded(a, b);
    }

    // gains: 1 / det of all i <= j <= k in order, 0 where it is 0. Keeps the best endpoints and gives their difference.
    CUDA_CALLABLE void cluster(const float* gains, const int* cuts, F* axis) {
        F best = zero(), place = zero();
        int n = 0;
        for (int i = 0; i < 17; ++i)
            for (int j = i; j < 17; ++j) {
                const F a = scaled[3 * i] + scaled[3 * j], b = scaled[3 * i + 1] + scaled[3 * j + 1],
                        c = scaled[3 * i + 2] + scaled[3 * j + 2];
                for (int k = j; k < 17; ++k, ++n) {
                    const F p = a + scaled[3 * k], q = b + scaled[3 * k + 1], r = c + scaled[3 * k + 2];
                    const F s = (p * p + q * q + r * r) * gains[n];
                    place = s > best ? zero() + (float)n : place; best = most(best, s);
                }
            }
        F a[3], b[3];
        for (int l = 0; l < NV; ++l) {
            const int at = (int)lane(place, l), i = cuts[at] & 31, j = cuts[at] >> 5 & 31, k = cuts[at] >> 10;
            const float w = (48 - i - j - k) * (1.0f / 3.0f), gain = gains[at] * (1.0f / 3.0f);
            for (int c = 0; c < 3; ++c) {
                const float u = (lane(sums[3 * i + c], l) + lane(sums[3 * j + c], l) + lane(sums[3 * k + c], l)) * gain;
                lane(a[c], l) = lane(mean[c], l) + u * w; lane(b[c], l) = lane(mean[c], l) - u * (16.0f - w);
            }
        }
        keep_rounded(a, b);
        for (int c = 0; c < 3; ++c) {    // in the metric, so that products with x are along the line
            axis[c] = zero();
            for (int d = 0; d < 3; ++d) axis[c] += G[4 * c + d] * (b[d] - a[d]);
        }
    }

    // Least squares for the indices of the best codes.
    CUDA_CALLABLE void refine() {
        F d[3], along[3], step = zero(), back = zero();
        for (int c = 0; c < 3; ++c) d[c] = (code[3 + c] - code[c]) * (1.0f / (3.0f * top(c)));
        for (int c = 0; c < 3; ++c) {
            along[c] = G[4 * c] * d[0] + G[4 * c + 1] * d[1] + G[4 * c + 2] * d[2];
            step += along[c] * d[c]; back += along[c] * (code[c] * (1.0f / top(c)) - mean[c]);
        }
        const F third = zero() + 1.0f / 3.0f;
        F w1 = zero(), w2 = zero(), v[3] = {zero(), zero(), zero()};
        for (int t = 0; t < 16; ++t) {
            const F s = x[3 * t] * along[0] + x[3 * t + 1] * along[1] + x[3 * t + 2] * along[2] - back;
            const F w = (s > 0.5f * step ? third : zero()) + (s > 1.5f * step ? third : zero())
                      + (s > 2.5f * step ? third : zero());
            w1 += w; w2 += w * w;
            for (int c = 0; c < 3; ++c) v[c] += w * x[3 * t + c];
        }
        const F det = 16.0f * w2 - w1 * w1, inverse = det > zero() + 1e-3f ? 1.0f / det : zero();
        F a[3], b[3];
        for (int c = 0; c < 3; ++c) {
            a[c] = mean[c] - v[c] * w1 * inverse; b[c] = mean[c] + v[c] * (16.0f - w1) * inverse;
        }
        keep_rounded(a, b);
    }

    // Steps the codes by one, in one channel or in all, as long as some block gains.
    CUDA_CALLABLE void nudge(int rounds) {
        for (int n = 0; n < rounds; ++n) {
            I gained = {};
            for (int move = 0; move < 32; ++move) {
                const int channel = move / 8, which = move % 8 + (move % 8 > 3);    // 4 is no step
                const float da = (float)(which % 3 - 1), db = (float)(which / 3 - 1);
                F k[6];
                for (int c = 0; c < 3; ++c) {
                    const bool on = channel == c || channel == 3;
                    k[c] = clamp(code[c] + (on ? da : 0.0f), top(c));
                    k[3 + c] = clamp(code[3 + c] + (on ? db : 0.0f), top(c));
                }
                gained = gained | keep(k);
            }
            if (!any(gained)) return;
        }
    }

    CUDA_CALLABLE void solve(const float* metric, const float* gains, const int* cuts, int rounds) {
        G = metric; R = metric + 16;
        prepare();
        F axis[3], own[3], y[48];
        for (int t = 0; t < 16; ++t) scale(x + 3 * t, y + 3 * t);
        principal(y, own);
        for (int c = 0; c < 3; ++c) axis[c] = R[c] * own[0] + R[4 + c] * own[1] + R[8 + c] * own[2];
        keep_flat();
        for (int n = 0; n < 2; ++n) { sort(axis); keep_extremes(); cluster(gains, cuts, axis); refine(); refine(); }
        nudge(rounds);
        refine();
    }
};
"""
