"""One training step of a BCf material: samples, features, network, loss and every gradient, in one pass (BCf §3, §5).

A step draws ``batch`` texture coordinates, samples the feature pyramids (trilinear, Eq. 10) and the reference pyramid
(bicubic over its own mips, §5.1), runs the network, and sums the gradient of the mean squared error (Eq. 5) into
texels and weights. Nothing of this touches main memory twice: a *patch* of 256 samples goes from coordinates to
gradients in a scratch that stays in the core's cache.

The host draws place, size, scale and weight of each patch, and ``patches`` says how everything lies in memory; the
jitter of the samples is a hash of (key, sample). Weights are packed as :func:`warp_neumat.kernels.mlp.pack` does it.
Gradients are summed in one buffer per *part*. A part is a fixed share of the patches, summed in a fixed order, so that
the same seed gives the same bits for the same number of parts.

The CPU code is native: per sample one 128-bit register holds a texel, per layer one 256-bit register holds 8 samples.
CUDA runs ``bcf_train_scalar``.
"""

import dataclasses
import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.bcf_train_scalar import make_scalar_step_kernel
from warp_neumat.kernels.mlp import layer_code
from warp_neumat.kernels.patches import PATCH

CUBIC = -0.75
"""Parameter of the bicubic kernel, the value that torch's ``grid_sample`` has."""


@dataclasses.dataclass(frozen=True)
class StepShape:
    """What a training kernel is compiled for."""

    textures: int
    hidden: int
    channels: int

    @property
    def inputs(self) -> int:
        """Inputs of the network: three a texture."""
        return 3 * self.textures

    @property
    def stride(self) -> int:
        """Channels of the reference, padded."""
        return -(-self.channels // 8) * 8

    @property
    def weights(self) -> int:
        """Parameters of the network."""
        return (self.inputs + 1) * self.hidden + (self.hidden + 1) * self.channels

    @property
    def scratch(self) -> int:
        """Float32 words of scratch a part needs."""
        rows = self.inputs + 2 * self.hidden + 2 * self.channels + 12
        transposed = self.inputs * (self.hidden + 1) + self.hidden * (self.channels + 1)
        return PATCH * rows + -(-transposed // 16) * 16 + 64


_HEAD = """
typedef float f4 __attribute__((vector_size(16), aligned(4), may_alias));
typedef float V __attribute__((vector_size(32), aligned(4), may_alias));
typedef int I8 __attribute__((vector_size(32), aligned(4), may_alias));
typedef unsigned U8 __attribute__((vector_size(32), aligned(4), may_alias));
typedef _Float16 h8 __attribute__((vector_size(16), aligned(2), may_alias));
enum { L = 256, NV = 8, T = %(T)d, H = %(H)d, C = %(C)d, IN = %(IN)d, CP = %(CP)d, GROUPS = CP / 8, NW = %(NW)d };
const V Z = {};
float* const base = scratch.data + (long long)part * %(SCRATCH)d;
float* const X = base;              // [IN][L] features, later their gradient
float* const Hd = X + IN * L;       // [H][L] hidden units
float* const D = Hd + H * L;        // [H][L] their gradient
float* const Y = D + H * L;         // [C][L] outputs, later their gradient
float* const G = Y + C * L;         // [C][L] reference
float* const PU = G + C * L;        // [12][L] coordinates, addresses and weights
float* const WB = PU + 12 * L;      // transposed weights behind rows of zero biases
float* const gw = weight_gradient.data + (long long)part * NW;
float* const gt = texel_gradient.data + (long long)part * 4 * texel_count;
const float* const net = weights.data;
const float* const tex = texels.data;
const _Float16* const ref = (const _Float16*)(const void*)reference.data;

// The backward pass multiplies by the transposed matrices.
float* const WT1 = WB; float* const WT0 = WB + H + C * H;
for (int i = 0; i < H; ++i) WT1[i] = 0.0f;
for (int c = 0; c < C; ++c) for (int k = 0; k < H; ++k) WT1[H + c * H + k] = net[H + IN * H + C + k * C + c];
for (int i = 0; i < IN; ++i) WT0[i] = 0.0f;
for (int k = 0; k < H; ++k) for (int i = 0; i < IN; ++i) WT0[IN + k * IN + i] = net[H + i * H + k];

auto hash = [](U8 a) { a = a * 747796405u + 2891336453u; a = ((a >> ((a >> 28) + 4u)) ^ a) * 277803737u;
                       return (a >> 22) ^ a; };
auto unit = [](U8 a) { return __builtin_convertvector((I8)(a >> 8), V) * 5.9604645e-8f; };
auto whole = [](V x) { I8 i = __builtin_convertvector(x, I8); V f = __builtin_convertvector(i, V);
                       return i + (I8)(f > x); };  // floor; a true comparison is -1
// sum over lanes of a[i][l] * b[j][l], added to out[i * stride + j]
auto outer = [&](const float* a, int rows, const float* b, int columns, float* out, int stride) {
    for (int i = 0; i < rows; i += 4) for (int j = 0; j < columns; j += 2) {
        V s00 = Z, s01 = Z, s10 = Z, s11 = Z, s20 = Z, s21 = Z, s30 = Z, s31 = Z;
        const float* a0 = a + i * L; const float* b0 = b + j * L;
        const int n1 = i + 1 < rows ? L : 0, n2 = i + 2 < rows ? 2 * L : 0, n3 = i + 3 < rows ? 3 * L : 0;
        const int m1 = j + 1 < columns ? L : 0;
        for (int l = 0; l < L; l += 8) {
            const V x0 = *(const V*)(b0 + l), x1 = *(const V*)(b0 + m1 + l);
            V y = *(const V*)(a0 + l); s00 += y * x0; s01 += y * x1;
            y = *(const V*)(a0 + n1 + l); s10 += y * x0; s11 += y * x1;
            y = *(const V*)(a0 + n2 + l); s20 += y * x0; s21 += y * x1;
            y = *(const V*)(a0 + n3 + l); s30 += y * x0; s31 += y * x1;
        }
        auto add = [&](int r, int c, V s) {
            if (i + r < rows && j + c < columns)
                out[(i + r) * stride + j + c] += ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7]));
        };
        add(0, 0, s00); add(0, 1, s01); add(1, 0, s10); add(1, 1, s11);
        add(2, 0, s20); add(2, 1, s21); add(3, 0, s30); add(3, 1, s31);
    }
};
auto total = [&](const float* a) { V s = Z; for (int l = 0; l < L; l += 8) s += *(const V*)(a + l);
    return ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7])); };
// Addresses of a mip's bilinear footprints: columns AX0, AX1, rows AY0, AY1, weights FX, FY.
int* const AX0 = (int*)(PU + 2 * L); int* const AX1 = AX0 + L; int* const AY0 = AX1 + L; int* const AY1 = AY0 + L;
float* const FX = PU + 6 * L; float* const FY = FX + L;
auto footprint = [&](const int* row) {
    const int w = row[1], h = row[2], columns = (w + 3) >> 2;
    for (int l = 0; l < L; l += 8) {
        const V x = *(const V*)(PU + l) * (float)w - 0.5f, y = *(const V*)(PU + L + l) * (float)h - 0.5f;
        I8 x0 = whole(x), y0 = whole(y);
        *(V*)(FX + l) = x - __builtin_convertvector(x0, V);
        *(V*)(FY + l) = y - __builtin_convertvector(y0, V);
        I8 x1 = x0 + 1, y1 = y0 + 1;
        const I8 left = x0 < 0, right = x1 >= w, above = y0 < 0, below = y1 >= h;
        if (repeat) {
            x0 += left & w; y0 += above & h; x1 &= ~right; y1 &= ~below;
        } else {
            x0 &= ~left; y0 &= ~above; x1 += right; y1 += below;
        }
        *(I8*)(AX0 + l) = 4 * (((x0 >> 2) << 4) + (x0 & 3)); *(I8*)(AX1 + l) = 4 * (((x1 >> 2) << 4) + (x1 & 3));
        *(I8*)(AY0 + l) = 4 * (((y0 >> 2) * columns << 4) + ((y0 & 3) << 2));
        *(I8*)(AY1 + l) = 4 * (((y1 >> 2) * columns << 4) + ((y1 & 3) << 2));
    }
};
// Scale of texture t (Eq. 11): the finer of two mips, and the weight of the coarser.
auto scale_of = [&](int t, float s, float& rest) {
    const int top = texture_mips.data[t] - 1;
    float st = s + biases.data[t]; st = st < 0.0f ? 0.0f : (st > (float)top ? (float)top : st);
    int m = (int)st; if (m >= top) m = top > 0 ? top - 1 : 0;
    rest = st - (float)m;
    return m;
};

for (int b = part; b < patch_count; b += parts) {
    const float* const patch = patches.data + 8 * b;
    const float s = patch[0];
    for (int l = 0; l < L; l += 8) {
        const U8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
        const U8 id = (lane + (unsigned)l + (unsigned)(b * L)) * 2u + (unsigned)key;
        const U8 r0 = hash(hash(id)), r1 = hash(hash(id + 1u) + 0x9E3779B9u);
        const V i = __builtin_convertvector((I8)((lane + (unsigned)l) & 15u), V), j = Z + (float)(l >> 4);
        V u = patch[2] + patch[4] * 0.0625f * (i + unit(r0)), v = patch[3] + patch[5] * 0.0625f * (j + unit(r1));
        const I8 over = u >= 1.0f, down = v >= 1.0f;
        u += __builtin_convertvector(over, V); v += __builtin_convertvector(down, V);
        if (patch[6] > 0.0f) {  // on the texel centres of a mip
            u = (__builtin_convertvector(whole(u * patch[6]), V) + 0.5f) / patch[6];
            v = (__builtin_convertvector(whole(v * patch[7]), V) + 0.5f) / patch[7];
        }
        *(V*)(PU + l) = u;
        *(V*)(PU + L + l) = v;
    }
    for (int l = 0; l < L; ++l) {
        samples.data[2 * (b * L + l)] = PU[l]; samples.data[2 * (b * L + l) + 1] = PU[L + l];
    }
"""

_REFERENCE = """
    // Reference: bicubic in the two nearest mips, linear between them.
    {
        int m = (int)s; if (m > mip_count - 2) m = mip_count > 1 ? mip_count - 2 : 0;
        const float rest = s - (float)m;
        float* const WX = PU + 4 * L; float* const WY = WX + 4 * L;  // [4][L] each; the footprints come later
        int* const AT = (int*)(PU + 2 * L);
        auto cubic = [](V t, float* w, int l) {
            const float A = %(A)s;
            const V a = t + 1.0f, q = 1.0f - t, c = 2.0f - t;
            *(V*)(w + l) = ((A * a - 5.0f * A) * a + 8.0f * A) * a - 4.0f * A;
            *(V*)(w + L + l) = ((A + 2.0f) * t - (A + 3.0f)) * t * t + 1.0f;
            *(V*)(w + 2 * L + l) = ((A + 2.0f) * q - (A + 3.0f)) * q * q + 1.0f;
            *(V*)(w + 3 * L + l) = ((A * c - 5.0f * A) * c + 8.0f * A) * c - 4.0f * A;
        };
        for (int n = 0; n < 2; ++n) {
            const float share = n ? rest : 1.0f - rest;
            if (n && rest == 0.0f) continue;
            const int* row = table.data + 3 * (16 * T + m + n);
            const int w = row[1], h = row[2], stride = w + 4;
            for (int l = 0; l < L; l += 8) {
                const V x = *(const V*)(PU + l) * (float)w - 0.5f, y = *(const V*)(PU + L + l) * (float)h - 0.5f;
                const I8 x0 = whole(x), y0 = whole(y);
                cubic(x - __builtin_convertvector(x0, V), WX, l);
                cubic(y - __builtin_convertvector(y0, V), WY, l);
                *(I8*)(AT + l) = row[0] + (y0 + 1) * stride + x0 + 1;
            }
            for (int l = 0; l < L; ++l) {
                const _Float16* p = ref + (long long)AT[l] * CP;
                V sum[GROUPS];
                for (int g = 0; g < GROUPS; ++g) sum[g] = Z;
                for (int r = 0; r < 4; ++r, p += stride * CP) {
                    const float wy = WY[r * L + l] * share;
                    const float k0 = WX[l] * wy, k1 = WX[L + l] * wy, k2 = WX[2 * L + l] * wy, k3 = WX[3 * L + l] * wy;
                    for (int g = 0; g < GROUPS; ++g) {
                        const _Float16* q = p + 8 * g;
                        sum[g] += k0 * __builtin_convertvector(*(const h8*)q, V);
                        sum[g] += k1 * __builtin_convertvector(*(const h8*)(q + CP), V);
                        sum[g] += k2 * __builtin_convertvector(*(const h8*)(q + 2 * CP), V);
                        sum[g] += k3 * __builtin_convertvector(*(const h8*)(q + 3 * CP), V);
                    }
                }
                if (n) { for (int c = 0; c < C; ++c) G[c * L + l] += sum[c >> 3][c & 7]; }
                else { for (int c = 0; c < C; ++c) G[c * L + l] = sum[c >> 3][c & 7]; }
            }
        }
    }
"""

_FEATURES = """
    for (int t = 0; t < T; ++t) {
        float rest; const int m = scale_of(t, s, rest);
        for (int n = 0; n < 2; ++n) {
            const float share = n ? rest : 1.0f - rest;
            if (n && share == 0.0f) continue;
            const int* row = table.data + 3 * (16 * t + m + n);
            footprint(row);
            const float* const mip = tex + 4ll * row[0];
            for (int l = 0; l < L; ++l) {
                const float* p = mip + AY0[l]; const float* q = mip + AY1[l]; const int x0 = AX0[l], x1 = AX1[l];
                const float fx = FX[l], fy = FY[l] * share, gy = share - fy;
                const float w11 = fx * fy, w10 = fy - w11, w01 = fx * gy, w00 = gy - w01;
                const f4 f = w00 * *(const f4*)(p + x0) + w01 * *(const f4*)(p + x1)
                           + w10 * *(const f4*)(q + x0) + w11 * *(const f4*)(q + x1);
                float* const x = X + 3 * t * L + l;
                if (n) { x[0] += f[0]; x[L] += f[1]; x[2 * L] += f[2]; }
                else { x[0] = f[0]; x[L] = f[1]; x[2 * L] = f[2]; }
            }
        }
    }
"""

_LOSS = """
    if (probe) {
        // Random signs in place of residuals: the squares of the gradient then average to the diagonal of JᵀJ.
        const float gain = __builtin_sqrtf(patch[1]);
        for (int c = 0; c < C; ++c) for (int l = 0; l < L; l += 8) {
            const U8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
            const U8 id = (lane + (unsigned)l + (unsigned)(b * L)) * (unsigned)C + (unsigned)c;
            const I8 bit = (I8)(hash(hash(id ^ 0x5bd1e995u) + (unsigned)key) & 2u) - 1;
            *(V*)(Y + c * L + l) = gain * __builtin_sqrtf(channel_weight.data[c]) * __builtin_convertvector(bit, V);
        }
    } else {
        const float gain = 2.0f * patch[1] / ((float)patch_count * (float)L * (float)C);
        for (int c = 0; c < C; ++c) {
            V sum = Z; const float k = gain * channel_weight.data[c];
            for (int l = 0; l < L; l += 8) {
                const V d = *(const V*)(Y + c * L + l) - *(const V*)(G + c * L + l);
                sum += d * d;
                *(V*)(Y + c * L + l) = k * d;
            }
            losses.data[b * C + c] = patch[1]
                * (((sum[0] + sum[4]) + (sum[1] + sum[5])) + ((sum[2] + sum[6]) + (sum[3] + sum[7]))) / (float)L;
        }
    }
    outer(Hd, H, Y, C, gw + H + IN * H + C, C);
    for (int c = 0; c < C; ++c) gw[H + IN * H + c] += total(Y + c * L);
"""

_BACK = """
    for (int k = 0; k < H; ++k) for (int l = 0; l < L; l += 8) {
        const I8 on = *(const V*)(Hd + k * L + l) > 0.0f;
        *(I8*)(D + k * L + l) &= on;
    }
    outer(X, IN, D, H, gw + H, H);
    for (int k = 0; k < H; ++k) gw[k] += total(D + k * L);
"""

_SCATTER = """
    for (int t = 0; t < T; ++t) {
        float rest; const int m = scale_of(t, s, rest);
        for (int n = 0; n < 2; ++n) {
            const float share = n ? rest : 1.0f - rest;
            if (share == 0.0f) continue;
            const int* row = table.data + 3 * (16 * t + m + n);
            footprint(row);
            float* const mip = gt + 4ll * row[0];
            for (int l = 0; l < L; ++l) {
                float* p = mip + AY0[l]; float* q = mip + AY1[l]; const int x0 = AX0[l], x1 = AX1[l];
                const float fx = FX[l], fy = FY[l] * share, gy = share - fy;
                const float w11 = fx * fy, w10 = fy - w11, w01 = fx * gy, w00 = gy - w01;
                const float* const x = X + 3 * t * L + l;
                const f4 g = {x[0], x[L], x[2 * L], 0.0f};
                *(f4*)(p + x0) += w00 * g; *(f4*)(p + x1) += w01 * g;
                *(f4*)(q + x0) += w10 * g; *(f4*)(q + x1) += w11 * g;
            }
        }
    }
}
"""


def _layer(inputs, outputs, source, weights, target, relu) -> str:
    """C++ of one dense layer over all lanes of a patch."""
    code = layer_code(
        inputs, outputs, source=f"({source} + t0)", stride=PATCH, target=f"({target} + t0)", target_stride=PATCH,
        offset=0, relu=relu, most=6, vectors=2,
    )  # fmt: skip
    return f"{{ const float* const w = {weights}; for (int t0 = 0; t0 < L; t0 += 16) {{ {code} }} }}\n"


def _cpu_code(shape: StepShape) -> str:
    n, h, c = shape.inputs, shape.hidden, shape.channels
    names = {
        "T": shape.textures, "H": h, "C": c, "IN": n, "CP": shape.stride, "NW": shape.weights,
        "SCRATCH": shape.scratch, "A": f"{CUBIC}f",
    }  # fmt: skip
    return "".join(
        [
            _HEAD % names,
            _REFERENCE % names,
            _FEATURES,
            _layer(n, h, "X", "net", "Hd", True),
            _layer(h, c, "Hd", f"(net + {h + n * h})", "Y", False),
            _LOSS,
            _layer(c, h, "Y", "WT1", "D", False),
            _BACK,
            _layer(h, n, "D", "WT0", "X", False),
            _SCATTER,
        ]
    )


def step_kernel(shape: StepShape, lanes: int):
    """Return the kernel of a training step: a thread is a part for ``lanes`` > 1, a sample for 1 (CUDA)."""
    return make_step_kernel(shape) if lanes > 1 else make_scalar_step_kernel(shape, CUBIC)


@functools.cache
def make_step_kernel(shape: StepShape):
    """Return the CPU kernel of a training step; one thread is one part."""

    @wp.func_native(_cpu_code(shape))
    def step_part(
        part: int,
        parts: int,
        key: int,
        repeat: int,
        probe: int,
        patches: wp.array(dtype=wp.float32),
        patch_count: int,
        table: wp.array(dtype=wp.int32),
        texture_mips: wp.array(dtype=wp.int32),
        biases: wp.array(dtype=wp.float32),
        mip_count: int,
        texels: wp.array(dtype=wp.float32),
        texel_count: int,
        reference: wp.array(dtype=wp.float16),
        weights: wp.array(dtype=wp.float32),
        channel_weight: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        texel_gradient: wp.array(dtype=wp.float32),
        weight_gradient: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
        samples: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def bcf_step_kernel(
        first: int,
        parts: int,
        key: int,
        repeat: int,
        probe: int,
        patches: wp.array(dtype=wp.float32),
        patch_count: int,
        table: wp.array(dtype=wp.int32),
        texture_mips: wp.array(dtype=wp.int32),
        biases: wp.array(dtype=wp.float32),
        mip_count: int,
        texels: wp.array(dtype=wp.float32),
        texel_count: int,
        reference: wp.array(dtype=wp.float16),
        weights: wp.array(dtype=wp.float32),
        channel_weight: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        texel_gradient: wp.array(dtype=wp.float32),
        weight_gradient: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
        samples: wp.array(dtype=wp.float32),
    ):
        step_part(
            first + wp.tid(), parts, key, repeat, probe, patches, patch_count, table, texture_mips, biases, mip_count,
            texels, texel_count, reference, weights, channel_weight, scratch, texel_gradient, weight_gradient, losses,
            samples,
        )  # fmt: skip

    return bcf_step_kernel
