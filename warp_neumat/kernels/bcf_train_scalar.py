"""The training step of ``bcf_train`` one sample a thread: what CUDA runs, and in C++ the proof of it.

The same arithmetic as the vector code, in the same order within a sample. Gradients of texels go straight into the one
buffer there is, by atomic additions; gradients of weights are summed over a warp of 32 threads first, because every
thread adds to the same few hundred. On the CPU, where nothing is atomic across workers, it must run on one worker.

Error: within 1e-5 of the vector kernel's largest gradient; held by test_the_cuda_step_equals_the_cpu_step.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch

_CODE = """
#ifdef __CUDA_ARCH__
#define BCF_ADD(address, value) atomicAdd(address, value)
#define BCF_ADD_ALL(address, value) { float sum = value; \\
    for (int d = 16; d > 0; d >>= 1) sum += __shfl_down_sync(0xffffffffu, sum, d); \\
    if ((threadIdx.x & 31) == 0) atomicAdd(address, sum); }
#else
#define BCF_ADD(address, value) (*(address) += (value))
#define BCF_ADD_ALL(address, value) BCF_ADD(address, value)
#endif
enum { T = %(T)d, H = %(H)d, C = %(C)d, IN = %(IN)d, CP = %(CP)d };
const int b = sample >> 8, l = sample & 255;
const float* const patch = patches.data + 8 * b;
const float* const net = weights.data;
const float s = patch[0];

auto hash = [](unsigned a) { a = a * 747796405u + 2891336453u; a = ((a >> ((a >> 28) + 4u)) ^ a) * 277803737u;
                             return (a >> 22) ^ a; };
auto unit = [](unsigned a) { return (float)(a >> 8) * 5.9604645e-8f; };
auto whole = [](float x) { int i = (int)x; return i - (int)((float)i > x); };
const unsigned id = ((unsigned)l + (unsigned)(b * 256)) * 2u + (unsigned)key;
float u = patch[2] + patch[4] * 0.0625f * ((float)(l & 15) + unit(hash(hash(id))));
float v = patch[3] + patch[5] * 0.0625f * ((float)(l >> 4) + unit(hash(hash(id + 1u) + 0x9E3779B9u)));
u -= u >= 1.0f ? 1.0f : 0.0f; v -= v >= 1.0f ? 1.0f : 0.0f;
if (patch[6] > 0.0f) {
    u = ((float)whole(u * patch[6]) + 0.5f) / patch[6];
    v = ((float)whole(v * patch[7]) + 0.5f) / patch[7];
}
samples.data[2 * sample] = u; samples.data[2 * sample + 1] = v;

float target[C]; float x[IN]; float h[H]; float y[C];
for (int c = 0; c < C; ++c) target[c] = 0.0f;
{
    int m = (int)s; if (m > mip_count - 2) m = mip_count > 1 ? mip_count - 2 : 0;
    const float rest = s - (float)m;
    auto cubic = [](float t, float* w) {
        const float A = %(A)s, a = t + 1.0f, q = 1.0f - t, c = 2.0f - t;
        w[0] = ((A * a - 5.0f * A) * a + 8.0f * A) * a - 4.0f * A;
        w[1] = ((A + 2.0f) * t - (A + 3.0f)) * t * t + 1.0f;
        w[2] = ((A + 2.0f) * q - (A + 3.0f)) * q * q + 1.0f;
        w[3] = ((A * c - 5.0f * A) * c + 8.0f * A) * c - 4.0f * A;
    };
    for (int n = 0; n < 2; ++n) {
        const float share = n ? rest : 1.0f - rest;
        if (n && rest == 0.0f) continue;
        const int* row = table.data + 3 * (16 * T + m + n);
        const float px = u * (float)row[1] - 0.5f, py = v * (float)row[2] - 0.5f;
        const int x0 = whole(px), y0 = whole(py), stride = row[1] + 4;
        float wx[4]; float wy[4];
        cubic(px - (float)x0, wx); cubic(py - (float)y0, wy);
        const long long at = (long long)(row[0] + (y0 + 1) * stride + x0 + 1) * CP;
        for (int j = 0; j < 4; ++j) for (int i = 0; i < 4; ++i) {
            const float k = wx[i] * (wy[j] * share);
            const long long p = at + (long long)(j * stride + i) * CP;
            for (int c = 0; c < C; ++c) target[c] += k * half_to_float(reference.data[p + c]);
        }
    }
}

// Texels of texture t at the finer and coarser mip, with their weights.
int at[T][8]; float share_of[T][8];
for (int t = 0; t < T; ++t) {
    const int top = texture_mips.data[t] - 1;
    float st = s + biases.data[t]; st = st < 0.0f ? 0.0f : (st > (float)top ? (float)top : st);
    int m = (int)st; if (m >= top) m = top > 0 ? top - 1 : 0;
    const float rest = st - (float)m;
    for (int n = 0; n < 2; ++n) {
        const float share = n ? rest : 1.0f - rest;
        const int* row = table.data + 3 * (16 * t + m + (share == 0.0f ? 0 : n));
        const int w = row[1], ht = row[2], columns = (w + 3) >> 2;
        const float px = u * (float)w - 0.5f, py = v * (float)ht - 0.5f;
        int x0 = whole(px), y0 = whole(py), x1 = x0 + 1, y1 = y0 + 1;
        const float fx = px - (float)x0, fy = (py - (float)y0) * share, gy = share - fy;
        if (repeat) {
            x0 += x0 < 0 ? w : 0; y0 += y0 < 0 ? ht : 0; x1 = x1 >= w ? 0 : x1; y1 = y1 >= ht ? 0 : y1;
        } else {
            x0 = x0 < 0 ? 0 : x0; y0 = y0 < 0 ? 0 : y0; x1 = x1 >= w ? w - 1 : x1; y1 = y1 >= ht ? ht - 1 : y1;
        }
        const int a0 = ((x0 >> 2) << 4) + (x0 & 3), a1 = ((x1 >> 2) << 4) + (x1 & 3);
        const int r0 = row[0] + ((y0 >> 2) * columns << 4) + ((y0 & 3) << 2);
        const int r1 = row[0] + ((y1 >> 2) * columns << 4) + ((y1 & 3) << 2);
        const float w11 = fx * fy, w10 = fy - w11, w01 = fx * gy, w00 = gy - w01;
        at[t][4 * n] = r0 + a0; at[t][4 * n + 1] = r0 + a1; at[t][4 * n + 2] = r1 + a0; at[t][4 * n + 3] = r1 + a1;
        share_of[t][4 * n] = w00; share_of[t][4 * n + 1] = w01;
        share_of[t][4 * n + 2] = w10; share_of[t][4 * n + 3] = w11;
    }
    for (int c = 0; c < 3; ++c) {
        float sum = 0.0f;
        for (int i = 0; i < 8; ++i) sum += share_of[t][i] * texels.data[4ll * at[t][i] + c];
        x[3 * t + c] = sum;
    }
}

for (int k = 0; k < H; ++k) {
    float sum = net[k];
    for (int i = 0; i < IN; ++i) sum += net[H + i * H + k] * x[i];
    h[k] = sum > 0.0f ? sum : 0.0f;
}
const float* const last = net + H + IN * H;
for (int c = 0; c < C; ++c) {
    float sum = last[c];
    for (int k = 0; k < H; ++k) sum += last[C + k * C + c] * h[k];
    const float d = sum - target[c];
    if (probe) {
        const unsigned mine = ((unsigned)l + (unsigned)(b * 256)) * (unsigned)C + (unsigned)c;
        const int bit = (int)(hash(hash(mine ^ 0x5bd1e995u) + (unsigned)key) & 2u) - 1;
        y[c] = sqrtf(patch[1]) * sqrtf(channel_weight.data[c]) * (float)bit;
    } else {
        BCF_ADD(losses.data + b * C + c, patch[1] * d * d * 0.00390625f);
        y[c] = 2.0f * patch[1] / ((float)patch_count * 256.0f * (float)C) * channel_weight.data[c] * d;
    }
}
for (int c = 0; c < C; ++c) {
    BCF_ADD_ALL(weight_gradient.data + H + IN * H + c, y[c]);
    for (int k = 0; k < H; ++k) BCF_ADD_ALL(weight_gradient.data + H + IN * H + C + k * C + c, h[k] * y[c]);
}
float g[IN];
for (int i = 0; i < IN; ++i) g[i] = 0.0f;
for (int k = 0; k < H; ++k) {
    float d = 0.0f;
    for (int c = 0; c < C; ++c) d += last[C + k * C + c] * y[c];
    d = h[k] > 0.0f ? d : 0.0f;
    BCF_ADD_ALL(weight_gradient.data + k, d);
    for (int i = 0; i < IN; ++i) {
        BCF_ADD_ALL(weight_gradient.data + H + i * H + k, x[i] * d);
        g[i] += net[H + i * H + k] * d;
    }
}
for (int t = 0; t < T; ++t) for (int i = 0; i < 8; ++i) {
    const float w = share_of[t][i];
    if (w != 0.0f) for (int c = 0; c < 3; ++c) BCF_ADD(texel_gradient.data + 4ll * at[t][i] + c, w * g[3 * t + c]);
}
"""


@functools.cache
def make_scalar_step_kernel(shape, cubic: float):
    """Return the kernel of a training step with one sample a thread; arguments as in the vector kernel.

    Args:
        shape: :class:`warp_neumat.kernels.bcf_train.StepShape`.
        cubic: Parameter of the bicubic kernel.

    ``losses`` and the gradients are added to; ``parts`` and ``scratch`` are not used. Launch 256 threads a patch.
    """
    names = {
        "T": shape.textures, "H": shape.hidden, "C": shape.channels, "IN": shape.inputs, "CP": shape.stride,
        "A": f"{cubic}f",
    }  # fmt: skip

    @wp.func_native(_CODE % names)
    def step_sample(
        sample: int,
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
        reference: wp.array(dtype=wp.float16),
        weights: wp.array(dtype=wp.float32),
        channel_weight: wp.array(dtype=wp.float32),
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
        step_sample(
            first + wp.tid(), key, repeat, probe, patches, patch_count, table, texture_mips, biases, mip_count, texels,
            reference, weights, channel_weight, texel_gradient, weight_gradient, losses, samples,
        )  # fmt: skip

    return bcf_step_kernel
