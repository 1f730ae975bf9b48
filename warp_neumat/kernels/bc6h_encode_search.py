"""Search of the BC6H fit as C++ text: partitions, lines, endpoints by least squares, indices, and the best so far.

Steps for a block:

1. Partition estimate: for all 32, the residual of a straight line per region in g, from sums over texels.
2. For the best ``tries`` of them, and for one region: the principal axis gives each texel a place t in [0, 1].
3. For each mode, from a few *starts* (t spread over all indices, or over the inner ones only, so that the palette
   reaches beyond the pixels and coarse endpoints find a better compromise), alternate: endpoints by least squares for
   fixed indices, straight on the codes (endpoint a at the nearest code and its neighbours, endpoint b the best for it,
   differences kept in range); then the palette as decoded, the best entry per texel, and the exact error.
4. The least error seen wins. An anchor texel in the upper half swaps its region's endpoints; where that breaks the
   difference range the trial is void (modes 10 and 11 have none, so some trial always counts).

In the linear metric a least-squares row is weighted by slopes of the value over half bits, renewed in every round.
Last, a winner of a coarse mode has each of its codes stepped by one.
"""

SEARCH = r"""
struct Mode { int number, regions, transformed, precision, reach[3], starts, coarse, outward; };

struct Fit : Number {
    F g[48], u[48], weight[48], row[48];   // targets in both domains, given weights, least-squares weights; [texel][3]
    F moment[160];                         // per texel: w, wx, wy, wz, wxx, wxy, wxz, wyy, wyz, wzz about the mean
    F mean[3], middle[3];                  // of g and of u
    F palette[48], index[16], place[16], estimate[32];
    I side[16], partition, anchor, code[12];
    F error; I mode, shape, codes[12]; F indices[16];    // the best so far

    BC6_CALL void prepare() {
        for (int c = 0; c < 3; ++c) {
            F s = {}, v = {};
            for (int t = 0; t < 16; ++t) { s += g[3 * t + c]; u[3 * t + c] = wide(g[3 * t + c]); v += u[3 * t + c]; }
            mean[c] = s * 0.0625f; middle[c] = v * 0.0625f;
            for (int t = 0; t < 16; ++t) u[3 * t + c] -= middle[c];
        }
        for (int t = 0; t < 16; ++t) {
            F* m = moment + 10 * t;
            const F x = g[3 * t] - mean[0], y = g[3 * t + 1] - mean[1], z = g[3 * t + 2] - mean[2];
            F w = zero() + 1.0f;
            if (WEIGHTED) w = (weight[3 * t] + weight[3 * t + 1] + weight[3 * t + 2]) * (1.0f / 3.0f);
            const F wx = w * x, wy = w * y, wz = w * z;
            m[0] = w; m[1] = wx; m[2] = wy; m[3] = wz;
            m[4] = wx * x; m[5] = wx * y; m[6] = wx * z; m[7] = wy * y; m[8] = wy * z; m[9] = wz * z;
        }
        error = zero() + 3.0e38f;
        mode = none(); shape = none();
        for (int k = 0; k < 12; ++k) codes[k] = none();
        for (int t = 0; t < 16; ++t) indices[t] = zero();
    }

    BC6_CALL void estimate_partitions(const int* partitions) {
        F all[10], one[10], two[10], axis[3], left[2];
        for (int k = 0; k < 10; ++k) { all[k] = zero(); for (int t = 0; t < 16; ++t) all[k] += moment[10 * t + k]; }
        for (int p = 0; p < 32; ++p) {
            for (int k = 0; k < 10; ++k) two[k] = zero();
            for (int t = 0; t < 16; ++t)
                if ((partitions[p] >> t) & 1) for (int k = 0; k < 10; ++k) two[k] += moment[10 * t + k];
            for (int k = 0; k < 10; ++k) one[k] = all[k] - two[k];
            // Along the line, eight entries leave about a fiftieth of the variance.
            F e = (spread(one, 2, axis, left) + spread(two, 2, axis, left + 1)) * 0.02f;
            estimate[p] = e + left[0] + left[1];
        }
    }

    CUDA_CALLABLE I next_partition() {
        F low = zero() + 3.3e38f; I best = none();
        for (int p = 0; p < 32; ++p) {
            const I better = estimate[p] < low;
            low = better ? estimate[p] : low; best = better ? none() + p : best;
        }
        for (int p = 0; p < 32; ++p) estimate[p] = best == p ? zero() + 3.4e38f : estimate[p];
        return best;
    }

    CUDA_CALLABLE void divide(int regions, I which, const int* partitions, const int* anchors) {
        partition = which; anchor = none() - 1;
        I mask = none();
        if (regions == 2)
            for (int l = 0; l < NV; ++l) {
                ((int*)&mask)[l] = partitions[((const int*)&which)[l]];
                ((int*)&anchor)[l] = anchors[((const int*)&which)[l]];
            }
        for (int t = 0; t < 16; ++t) side[t] = ((mask >> t) & 1) != 0;
    }

    // 1 where texel t lies in region r, else 0.
    CUDA_CALLABLE F within(int t, int r) const { return side[t] ? zero() + (float)(r) : zero() + (float)(1 - r); }

    // Place of each texel between the ends of its region's line.
    BC6_CALL void project(int regions) {
        F start[3], step[3], lo[2], hi[2], s[10], axis[2][3], centre[2][3], left;
        for (int r = 0; r < regions; ++r) {
            for (int k = 0; k < 10; ++k) {
                s[k] = zero();
                for (int t = 0; t < 16; ++t) s[k] += within(t, r) * moment[10 * t + k];
            }
            spread(s, 4, axis[r], &left);
            const F inv = s[0] > zero() ? 1.0f / most(s[0], zero() + 1e-30f) : zero();
            for (int c = 0; c < 3; ++c) centre[r][c] = s[1 + c] * inv;
            lo[r] = zero() + 3e38f; hi[r] = zero() - 3e38f;
        }
        for (int t = 0; t < 16; ++t)
            for (int r = 0; r < regions; ++r) {
                F d = zero();
                for (int c = 0; c < 3; ++c) d += (g[3 * t + c] - mean[c] - centre[r][c]) * axis[r][c];
                const I in = within(t, r) > zero();
                place[t] = in ? d : place[t];
                lo[r] = in ? least(lo[r], d) : lo[r];
                hi[r] = in ? most(hi[r], d) : hi[r];
            }
        if (!LINEAR) {
            for (int t = 0; t < 16; ++t) {
                const int r = regions - 1;    // with one region no texel is on the other side
                const F a = side[t] ? lo[r] : lo[0], b = side[t] ? hi[r] : hi[0];
                place[t] = b > a ? (place[t] - a) / most(b - a, zero() + 1e-30f) : zero();
            }
            return;
        }
        // The palette is straight in u, not in the linear value: keep the line's ends, and project once more there.
        for (int r = 0; r < regions; ++r) {
            F length = zero();
            for (int c = 0; c < 3; ++c) length += axis[r][c] * axis[r][c];
            const F inv = length > zero() ? 1.0f / most(length, zero() + 1e-30f) : zero();
            F a[3], b[3];
            for (int c = 0; c < 3; ++c) {
                const F o = mean[c] + centre[r][c], d = axis[r][c] * inv;
                a[c] = wide(in_range(o + d * lo[r])) - middle[c]; b[c] = wide(in_range(o + d * hi[r])) - middle[c];
            }
            for (int t = 0; t < 16; ++t) {
                F n = zero(), m = zero();
                for (int c = 0; c < 3; ++c) {
                    const F d = b[c] - a[c], w = row[3 * t + c];
                    n += w * d * (u[3 * t + c] - a[c]); m += w * d * d;
                }
                F p = m > zero() ? n / most(m, zero() + 1e-37f) : zero();
                p = least(most(p, zero()), zero() + 1.0f);
                const I in = within(t, r) > zero();
                place[t] = in ? p : place[t];
            }
        }
    }

    CUDA_CALLABLE void reset_rows() {
        for (int k = 0; k < 48; ++k) {
            row[k] = WEIGHTED ? weight[k] : zero() + 1.0f;
            if (LINEAR) row[k] *= slope(g[k], g[k]);
        }
    }

    // Swap the ends of regions whose anchor has an index in the upper half.
    CUDA_CALLABLE void orient(int regions) {
        const float top = regions == 2 ? 7.0f : 15.0f;
        I flip[2]; flip[0] = index[0] > 0.5f * top; flip[1] = flip[0];
        if (regions == 2) {
            F at = zero();
            for (int t = 1; t < 16; ++t) at = anchor == t ? index[t] : at;
            flip[1] = at > 0.5f * top;
        }
        for (int t = 0; t < 16; ++t) index[t] = (side[t] ? flip[1] : flip[0]) ? top - index[t] : index[t];
        for (int r = 0; r < regions; ++r)
            for (int c = 0; c < 3; ++c) {
                I& a = code[6 * r + c]; I& b = code[6 * r + 3 + c];
                const I x = a, y = b;
                a = flip[r] ? y : x; b = flip[r] ? x : y;
            }
    }

    // The last code before v, or the first after it.
    CUDA_CALLABLE static I beside(F v, I up, int precision) {
        const I q = quantise(v, precision), low = none() - (SIGNED ? (1 << (precision - 1)) - 1 : 0);
        const F at = BC6_F(unquantise(q, precision));
        I next = up ? (at < v ? q + 1 : q) : (at > v ? q - 1 : q);
        return least(most(next, low), none() + ((1 << (precision - SIGNED)) - 1));
    }

    // Codes by least squares for the present indices; outward: rounded away from each other instead of to the nearest.
    BC6_CALL void solve(const Mode& m, bool outward) {
        const float scale = m.regions == 2 ? 64.0f / 7.0f : 64.0f / 15.0f;
        F wb[16];
        for (int t = 0; t < 16; ++t) wb[t] = BC6_F(BC6_I(index[t] * scale + 0.5f)) * 0.015625f;
        for (int r = 0; r < m.regions; ++r) {
            F wa[16], wr[16], aa = zero(), ab = zero(), bb = zero();    // weights of both ends in this region
            for (int t = 0; t < 16; ++t) {
                const F on = within(t, r);
                wr[t] = on * wb[t]; wa[t] = on - wr[t];
                if (!ROWS) { aa += wa[t] * wa[t]; ab += wa[t] * wr[t]; bb += wr[t] * wr[t]; }
            }
            for (int c = 0; c < 3; ++c) {
                F ra = zero(), rb = zero();
                if (ROWS) { aa = zero(); ab = zero(); bb = zero(); }
                for (int t = 0; t < 16; ++t) {
                    F y = u[3 * t + c];
                    if (ROWS) {
                        const F k = row[3 * t + c], x = k * wa[t], z = k * wr[t];
                        aa += x * wa[t]; ab += x * wr[t]; bb += z * wr[t];
                        y = k * y;
                    }
                    ra += wa[t] * y; rb += wr[t] * y;
                }
                const F total = aa + 2.0f * ab + bb, det = aa * bb - ab * ab;
                const I good = det > 1e-4f * total * total;
                const F even = total > zero() ? (ra + rb) / most(total, zero() + 1e-37f) : zero();
                const F inv = 1.0f / (good ? det : zero() + 1.0f);
                const F a = good ? (ra * bb - rb * ab) * inv : even, b = good ? (rb * aa - ra * ab) * inv : even;
                const I base = code[c];
                const F inb = bb > zero() ? 1.0f / most(bb, zero() + 1e-37f) : zero();
                I qa = none(), qb = none(); F low = zero() + 3.3e38f;
                const int edge = (1 << (m.precision - SIGNED)) - 1;
                // For coarse codes both neighbours of the solution are tried, with the best partner of each.
                const bool both = m.coarse && !outward;
                const F A = a + middle[c], B = b + middle[c];
                const I up = outward ? a > b : none() != 0;
                const I first = m.coarse ? beside(A, up, m.precision) : quantise(A, m.precision);
                for (int k = 0; k <= both; ++k) {
                    I ca = least(first + k, none() + edge);
                    if (m.transformed && r == 1) ca = least(most(ca, base - m.reach[c]), base + (m.reach[c] - 1));
                    const F va = BC6_F(unquantise(ca, m.precision)) - middle[c];
                    const F target = bb > 1e-4f * total ? (rb - ab * va) * inb : b;
                    I cb = outward ? beside(B, b >= a, m.precision) : quantise(target + middle[c], m.precision);
                    if (m.transformed) {
                        const I origin = r == 1 ? base : ca;
                        cb = least(most(cb, origin - m.reach[c]), origin + (m.reach[c] - 1));
                    }
                    const F vb = BC6_F(unquantise(cb, m.precision)) - middle[c];
                    const F e = va * (aa * va + 2.0f * (ab * vb - ra)) + vb * (bb * vb - 2.0f * rb);
                    const I better = e < low;
                    low = better ? e : low; qa = better ? ca : qa; qb = better ? cb : qb;
                }
                code[6 * r + c] = qa; code[6 * r + 3 + c] = qb;
            }
        }
    }

    // Indices for the present codes, anchors in the lower half, and the exact error of the decoded block.
    BC6_CALL F choose(const Mode& m) {
        const int levels = m.regions == 2 ? 8 : 16;
        for (int r = 0; r < m.regions; ++r)
            for (int c = 0; c < 3; ++c) {
                const I a = unquantise(code[6 * r + c], m.precision), b = unquantise(code[6 * r + 3 + c], m.precision);
                for (int i = 0; i < levels; ++i) {
                    const int w = (128 * i + levels - 1) / (2 * levels - 2);
                    const I v = (a * (64 - w) + b * w + 32) >> 6;
                    I h = (magnitude(v) * 31) >> (6 - SIGNED);
                    if (SIGNED) h = v < none() ? -h : h;
                    palette[3 * (levels * r + i) + c] = LINEAR ? value_of(h) : BC6_F(h);
                }
            }
        const F* other = palette + (m.regions == 2 ? 24 : 0);
        F total = zero();
        for (int t = 0; t < 16; ++t) {
            F low = zero() + 3.3e38f, at = zero(), d0 = zero(), d1 = zero(), d2 = zero();
            for (int i = 0; i < levels; ++i) {
                const F p0 = side[t] ? other[3 * i] : palette[3 * i];
                const F p1 = side[t] ? other[3 * i + 1] : palette[3 * i + 1];
                const F p2 = side[t] ? other[3 * i + 2] : palette[3 * i + 2];
                const F x = g[3 * t] - p0, y = g[3 * t + 1] - p1, z = g[3 * t + 2] - p2;
                const F e = WEIGHTED ? weight[3 * t] * x * x + weight[3 * t + 1] * y * y + weight[3 * t + 2] * z * z
                                     : x * x + y * y + z * z;
                const I better = e < low;
                low = better ? e : low; at = better ? zero() + (float)(i) : at;
                if (LINEAR) { d0 = better ? p0 : d0; d1 = better ? p1 : d1; d2 = better ? p2 : d2; }
            }
            index[t] = at; total += low;
            if (LINEAR) {
                row[3 * t] = slope(g[3 * t], d0); row[3 * t + 1] = slope(g[3 * t + 1], d1);
                row[3 * t + 2] = slope(g[3 * t + 2], d2);
                if (WEIGHTED) for (int c = 0; c < 3; ++c) row[3 * t + c] *= weight[3 * t + c];
            }
        }
        orient(m.regions);
        if (m.transformed) {
            I inside = none() == none();
            for (int e = 1; e < 2 * m.regions; ++e)
                for (int c = 0; c < 3; ++c) {
                    const I d = code[3 * e + c] - code[c];
                    inside = inside & (d >= -m.reach[c]) & (d < m.reach[c]);
                }
            total = inside ? total : zero() + 3.4e38f;
        }
        return total;
    }

    CUDA_CALLABLE static bool any(I mask) {
        for (int l = 0; l < NV; ++l) if (((const int*)&mask)[l]) return true;
        return false;
    }

    BC6_CALL void keep(const Mode& m, F e, I allowed) {
        const I better = (e < error) & allowed;
        if (!any(better)) return;
        error = better ? e : error;
        mode = better ? none() + m.number : mode; shape = better ? partition : shape;
        for (int k = 0; k < 12; ++k) codes[k] = better ? (k < 6 * m.regions ? code[k] : none()) : codes[k];
        for (int t = 0; t < 16; ++t) indices[t] = better ? index[t] : indices[t];
    }

    // Alternate from the present indices. A block drops out once a round stays far from its best: each by itself, so
    // that no result depends on the other blocks of the vector.
    BC6_CALL void descend(const Mode& m, I allowed, int rounds, bool outward) {
        orient(m.regions);
        for (int n = 0; n < rounds; ++n) {
            solve(m, outward && n == 0);
            const F e = choose(m);
            keep(m, e, allowed);
            allowed = allowed & (e < 5.0f * error);
            if (!any(allowed)) return;
        }
    }
    CUDA_CALLABLE void begin(const Mode& m, I allowed, int start, int rounds, bool outward) {
        const float top = m.regions == 2 ? 7.0f : 15.0f;
        if (LINEAR) reset_rows();
        for (int t = 0; t < 16; ++t) index[t] = BC6_F(BC6_I(place[t] * (top - 2 * start) + (start + 0.5f)));
        descend(m, allowed, rounds, outward);
    }
    // Step each code by itself down and up.
    CUDA_CALLABLE void nudge(const Mode& m, I allowed) {
        const int high = (1 << (m.precision - SIGNED)) - 1, low = SIGNED ? -high : 0;
        for (int k = 0; k < 12 * m.regions; ++k) {
            for (int j = 0; j < 12; ++j) code[j] = codes[j];
            I& one = code[k >> 1];
            one = least(most(one + (k & 1 ? 1 : -1), none() + low), none() + high);
            keep(m, choose(m), allowed);
        }
    }
    // Give the best trial so far of each block more rounds and other starts, where it is of mode m.
    CUDA_CALLABLE void polish(const Mode& m, const int* partitions, const int* anchors) {
        const I mine = (mode == m.number) & (error > zero());
        if (!any(mine)) return;
        divide(m.regions, shape, partitions, anchors);
        project(m.regions);
        for (int start = 0; start < m.starts; ++start) begin(m, mine, start, 2, false);
        for (int k = 0; k < 12; ++k) code[k] = codes[k];
        for (int t = 0; t < 16; ++t) index[t] = indices[t];
        if (LINEAR) reset_rows();
        descend(m, mine, 3, false);
        if (m.coarse) nudge(m, mine);
    }
};
"""
