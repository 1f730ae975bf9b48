"""One training step of NTBC: two networks, five losses and every gradient, in one pass (NTBC §3.1, 3.2, App. A).

A *patch* of :data:`PATCH` blocks goes from grid look-ups to gradients in a scratch that stays in the core's cache: one
row of the endpoint network per block, 16 of the texel network. Between forward and backward stands the *head*, which
compares what the networks say with reference colours and endpoints, plane by plane (a plane is what one kind of block
holds: ``channels`` numbers a texel, a palette of ``entries`` on the line between two endpoints, NTBC Eq. 7, 14).

Losses, squared differences δᵀGδ in the plane's metric G, weighed at run time; ĉ, ê are predicted, c, e the reference:

0. L_e: ê − e (NTBC Eq. 11);
1. L_cd of the endpoint network: the index of the palette entry of ê nearest to c, decoded with e, against c;
2. L_c: ĉ − c (NTBC Eq. 12);
3. L_cd of the colour network: the index of the palette entry of e nearest to ĉ, decoded with e, against c;
4. joint: the index of the palette entry of ê nearest to ĉ, decoded with ê, against c. That is the error of what is
   written. Its gradient reaches ê through the decoding and ĉ through the index.

The gradient passes the choice of an index as if the weight were its expectation under softmax(d / T), d the negative
distances: ∂w/∂d_n = σ_n (w_n − ŵ) / T (NTBC Eq. 30, where n stands for the weight w_n). Distances are taken in parts:
with a = x − e0 and d = e1 − e0, entry n lies at squared distance |a − t d|² + (w_n − t)² |d|², where t is the place of
x's projection on the line. No difference of large numbers, and the nearest entry is the rounded t.

In the naive variant (NTBC §3.1) the texel network says one weight per plane and only losses 0 and 4 exist.

Gradients are summed in one buffer per *part*, a fixed share of the patches in a fixed order, so the same number of
parts gives the same bits. CPU only.
"""

import dataclasses
import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.ntbc_network import (
    HEAD,
    Layout,
    NetworkCode,
    NetworkShape,
    check_outputs,
)

PATCH = 8
"""Blocks that go through the networks at once: 128 rows of the texel network."""

LOSSES = ("endpoint", "decoded_endpoint", "colour", "decoded_colour", "joint")
"""Names of the losses, in the order of weights and results."""


@dataclasses.dataclass(frozen=True)
class StepShape:
    """Sizes of a training step: two networks and the planes that they serve.

    ``planes`` are (entries, channels): (4, 3) for BC1, (8, 1) for BC4, (16, 3) or (16, 4) for BC7.
    """

    endpoint: NetworkShape
    texel: NetworkShape
    planes: tuple[tuple[int, int], ...]
    naive: bool = False

    def __post_init__(self):
        if not self.planes or any(entries < 2 or not 1 <= channels <= 4 for entries, channels in self.planes):
            raise ValueError(f"planes must be (entries, channels) of at least 2 and 1 to 4, got {self.planes}")
        check_outputs(self.endpoint, self.texel, len(self.planes), self.channels, self.naive, self.planes)

    @property
    def channels(self) -> int:
        """Channels of all planes."""
        return sum(channels for _, channels in self.planes)

    @property
    def scratch(self) -> int:
        """Float32 words of scratch a part needs."""
        return sum(code.scratch() for code in _codes(self.endpoint.layout, self.texel.layout)) + 64

    @property
    def flops(self) -> int:
        """Operations of all matrix products of one block, forward and backward, as executed."""
        return 3 * (self.endpoint.flops + 16 * self.texel.flops)


def _codes(endpoint: Layout, texel: Layout) -> tuple[NetworkCode, NetworkCode]:
    return NetworkCode(endpoint, "E", PATCH), NetworkCode(texel, "X", 16 * PATCH)


_BEGIN = """
enum { C = %(channels)d, EW = %(endpoint_width)d, XW = %(texel_width)d };
const float* const E_net = endpoint_net.data; const float* const X_net = texel_net.data;
const float* const E_grid = endpoint_grid.data; const float* const X_grid = texel_grid.data;
const int* const E_table = endpoint_table.data; const int* const X_table = texel_table.data;
float* const E_net_gradient = endpoint_net_gradient.data + (long long)part * %(endpoint_weights)d;
float* const X_net_gradient = texel_net_gradient.data + (long long)part * %(texel_weights)d;
float* const E_grid_gradient = endpoint_grid_gradient.data + (long long)part * endpoint_words;
float* const X_grid_gradient = texel_grid_gradient.data + (long long)part * texel_words;
float* at = scratch.data + (long long)part * %(scratch)d;
at += (16 - ((unsigned long long)at / 4) %% 16) %% 16;
const float* const factor = loss_weights.data;
const float per_colour = 1.0f / (16.0f * C * %(patch)d), per_endpoint = 1.0f / (2.0f * C * %(patch)d);
// Twice the weight over the number of terms: what a difference is multiplied with in the gradient.
const float gain_e = 2.0f * factor[0] * per_endpoint / patch_count,
    gain_ecd = 2.0f * factor[1] * per_colour / patch_count,
    gain_c = 2.0f * factor[2] * per_colour / patch_count, gain_ccd = 2.0f * factor[3] * per_colour / patch_count,
    gain_joint = 2.0f * factor[4] * per_colour / patch_count;
auto root = [](V x) { return __builtin_elementwise_sqrt(x); };
"""

# One plane of a patch. K, N: channels and entries; lambdas see them as constants.
_PLANE = """
auto plane_%(N)d_%(K)d = [&](const int plane, const int channel) {
    enum { K = %(K)d, N = %(N)d };
    const float* const G = metric.data + 16 * plane;
    auto quadratic = [&](const V* x, const V* y) { V s = Z; for (int i = 0; i < K; ++i) { V r = Z;
        for (int j = 0; j < K; ++j) r += y[j] * G[4 * i + j]; s += x[i] * r; } return s; };
    // The line between two endpoints: e0, difference d, G d and dᵀGd.
    struct Line { float e0[K], d[K], m[K], size; };
    auto line = [&](const float* e) { Line o; o.size = 0.0f;
        for (int i = 0; i < K; ++i) { o.e0[i] = e[i]; o.d[i] = e[K + i] - e[i]; }
        for (int i = 0; i < K; ++i) { o.m[i] = 0.0f; for (int j = 0; j < K; ++j) o.m[i] += G[4 * i + j] * o.d[j];
            o.size += o.d[i] * o.m[i]; }
        return o; };
    // Where the colours x project on the line, what is across it, and the weight of the nearest entry.
    struct Choice { V t, across[K], weight; };
    auto nearest = [&](V t) { return __builtin_elementwise_ceil(smaller(larger(t * (N - 1.0f) - 0.5f, Z),
        Z + (N - 1.0f))) * (1.0f / (N - 1)); };
    auto choose = [&](const V* x, const Line& o) { Choice f; V s = Z;
        for (int i = 0; i < K; ++i) s += (x[i] - o.e0[i]) * o.m[i];
        f.t = s / (o.size + 1e-20f);
        for (int i = 0; i < K; ++i) f.across[i] = (x[i] - o.e0[i]) - f.t * o.d[i];
        f.weight = nearest(f.t); return f; };
    // Eq. 30: with the loss' slope by the weight, the slopes h_n by distance over the distances, summed against the
    // differences x - c_n: zero[i] all of them, one[i] weighed with w_n.
    auto soften = [&](const Choice& f, const Line& o, V slope, V* zero, V* one) {
        const V base = quadratic(f.across, f.across) + 1e-12f;
        V u = f.weight - f.t;
        const V least = root(base + o.size * u * u);
        V z[N], total = Z, mean = Z;
        for (int n = 0; n < N; ++n) {
            u = (float)n / (N - 1) - f.t;
            const V r = root(base + o.size * u * u), p = exponential((least - r) * sharpness);
            total += p; mean += p * ((float)n / (N - 1)); z[n] = p / r;
        }
        mean = mean / total;
        V h0 = Z, k0 = Z, h1 = Z, k1 = Z;
        for (int n = 0; n < N; ++n) {
            const float w = (float)n / (N - 1);
            const V h = z[n] * (w - mean), k = h * (f.t - w);
            h0 += h; k0 += k; h1 += h * w; k1 += k * w;
        }
        const V scale = slope * sharpness / total;
        for (int i = 0; i < K; ++i) { zero[i] = scale * (h0 * f.across[i] + k0 * o.d[i]);
            one[i] = scale * (h1 * f.across[i] + k1 * o.d[i]); }
    };
    for (int b = 0; b < %(patch)d; ++b) {
        const long long block = numbers[b];
        const float* const wanted = colours.data + (block * C + channel) * 16;
        const float* const ends = endpoints.data + (block * C + channel) * 2;
        const float* const guess = E_Y + b * EW + 2 * channel;
        const Line said = line(guess), given = line(ends);
        float gradient[2 * K];
        for (int e = 0; e < 2; ++e) for (int i = 0; i < K; ++i) { float r = 0.0f;
            for (int j = 0; j < K; ++j) r += G[4 * i + j] * (guess[e * K + j] - ends[e * K + j]);
            loss_e += r * (guess[e * K + i] - ends[e * K + i]); gradient[e * K + i] = gain_e * r; }
        V ends0[K], ends1[K];  // what the endpoints' gradient is before G
        for (int i = 0; i < K; ++i) ends0[i] = ends1[i] = Z;
        for (int h = 0; h < 16; h += 8) {
            V c[K], decoded[K];
            for (int i = 0; i < K; ++i) c[i] = *(const V*)(wanted + 16 * i + h);
            float* const out = X_D + (16 * b + h) * XW;
            const float* const in = X_Y + (16 * b + h) * XW;
            %(texels)s
        }
        for (int i = 0; i < K; ++i) { float s0 = 0.0f, s1 = 0.0f;
            for (int j = 0; j < K; ++j) { s0 += G[4 * i + j] * sum8(ends0[j]); s1 += G[4 * i + j] * sum8(ends1[j]); }
            gradient[i] += s0; gradient[K + i] += s1; }
        for (int i = 0; i < 2 * K; ++i) E_D[b * EW + 2 * channel + i] = gradient[i] * guess[i] * (1.0f - guess[i]);
    }
};
"""

_COLOURS = """
V x[K], slope[K], zero[K], one[K];
for (int i = 0; i < K; ++i) for (int l = 0; l < 8; ++l) x[i][l] = in[l * XW + channel + i];
for (int i = 0; i < K; ++i) decoded[i] = x[i] - c[i];
loss_c += quadratic(decoded, decoded);
for (int i = 0; i < K; ++i) slope[i] = gain_c * decoded[i];
{   // L_cd of the endpoint network.
    const Choice f = choose(c, said);
    for (int i = 0; i < K; ++i) decoded[i] = given.e0[i] + f.weight * given.d[i] - c[i];
    loss_ecd += quadratic(decoded, decoded);
    if (factor[1] != 0.0f) {
        V along = Z; for (int i = 0; i < K; ++i) along += decoded[i] * given.m[i];
        soften(f, said, gain_ecd * along, zero, one);
        for (int i = 0; i < K; ++i) { ends0[i] += zero[i] - one[i]; ends1[i] += one[i]; }
    }
}
{   // L_cd of the colour network.
    const Choice f = choose(x, given);
    for (int i = 0; i < K; ++i) decoded[i] = given.e0[i] + f.weight * given.d[i] - c[i];
    loss_ccd += quadratic(decoded, decoded);
    if (factor[3] != 0.0f) {
        V along = Z; for (int i = 0; i < K; ++i) along += decoded[i] * given.m[i];
        soften(f, given, gain_ccd * along, zero, one);
        for (int i = 0; i < K; ++i) slope[i] -= zero[i];
    }
}
{   // The joint loss.
    const Choice f = choose(x, said);
    for (int i = 0; i < K; ++i) decoded[i] = said.e0[i] + f.weight * said.d[i] - c[i];
    loss_joint += quadratic(decoded, decoded);
    if (factor[4] != 0.0f) {
        V along = Z; for (int i = 0; i < K; ++i) { along += decoded[i] * said.m[i]; decoded[i] *= gain_joint;
            ends0[i] += decoded[i] - f.weight * decoded[i]; ends1[i] += f.weight * decoded[i]; }
        soften(f, said, gain_joint * along, zero, one);
        for (int i = 0; i < K; ++i) slope[i] -= zero[i];
    }
}
if (texel_backward) for (int i = 0; i < K; ++i) { V s = Z; for (int j = 0; j < K; ++j) s += slope[j] * G[4 * i + j];
    s *= x[i] * (1.0f - x[i]);
    for (int l = 0; l < 8; ++l) out[l * XW + channel + i] = s[l]; }
"""

_WEIGHTS = """
V w; for (int l = 0; l < 8; ++l) w[l] = in[l * XW + plane];
const V used = quantised ? nearest(w) : w;
V along = Z;
for (int i = 0; i < K; ++i) decoded[i] = said.e0[i] + used * said.d[i] - c[i];
loss_joint += quadratic(decoded, decoded);
for (int i = 0; i < K; ++i) { along += decoded[i] * said.m[i]; decoded[i] *= gain_joint;
    ends0[i] += decoded[i] - used * decoded[i]; ends1[i] += used * decoded[i]; }
along *= gain_joint * w * (1.0f - w);
if (texel_backward) for (int l = 0; l < 8; ++l) out[l * XW + plane] = along[l];
"""


def _cpu_code(endpoint: Layout, texel: Layout, planes, naive: bool) -> str:
    codes = ends, texels = _codes(endpoint, texel)
    channels = sum(k for _, k in planes)
    text = [HEAD]
    text.append(
        _BEGIN
        % {
            "channels": channels, "endpoint_width": endpoint.rows[-1], "texel_width": texel.rows[-1],
            "endpoint_weights": endpoint.weights, "texel_weights": texel.weights, "patch": PATCH,
            "scratch": sum(code.scratch() for code in codes) + 64,
        }
    )  # fmt: skip
    if naive:
        text.append("const bool endpoint_backward = factor[0] != 0.0f || factor[4] != 0.0f;")
        text.append("const bool texel_backward = factor[4] != 0.0f && !quantised;")
    else:
        text.append("const bool endpoint_backward = factor[0] != 0.0f || factor[1] != 0.0f || factor[4] != 0.0f;")
        text.append("const bool texel_backward = factor[2] != 0.0f || factor[3] != 0.0f || factor[4] != 0.0f;")
    for code in codes:
        text.append(code.declare())
        size = code.count * code.layout.rows[-1]
        text.append(f"for (int i = 0; i < {size}; ++i) {code.name}_D[i] = 0.0f;")  # padding is never written again
    text.append("const int* numbers; float loss_e; V loss_ecd, loss_c, loss_ccd, loss_joint;")
    for entries, k in sorted(set(planes)):
        text.append(_PLANE % {"N": entries, "K": k, "patch": PATCH, "texels": _WEIGHTS if naive else _COLOURS})
    text.append("for (int patch = part; patch < patch_count; patch += parts) {")
    text.append(f"numbers = blocks.data + {PATCH} * patch;")
    text.append("loss_e = 0.0f; loss_ecd = loss_c = loss_ccd = loss_joint = Z;")
    text += [ends.gather(ends.blocks), ends.forward(), texels.gather(texels.texels), texels.forward()]
    channel = 0
    for plane, (entries, k) in enumerate(planes):
        text.append(f"plane_{entries}_{k}({plane}, {channel});")
        channel += k
    sums = ("sum8(loss_ecd)", "sum8(loss_c)", "sum8(loss_ccd)", "sum8(loss_joint)")
    text.append("float* const loss = losses.data + 5 * patch; loss[0] = loss_e * per_endpoint;")
    text += [f"loss[{n + 1}] = {value} * per_colour;" for n, value in enumerate(sums)]
    for code, visit, flag in ((ends, ends.blocks, "endpoint"), (texels, texels.texels, "texel")):
        text.append(f"if ({flag}_backward) {{ {code.backward()} {code.scatter(visit)} }}")
    text.append("}")
    return "\n".join(text)


@functools.cache
def _make_kernel(endpoint: Layout, texel: Layout, planes: tuple[tuple[int, int], ...], naive: bool):
    @wp.func_native(_cpu_code(endpoint, texel, planes, naive))
    def step_part(
        part: int,
        parts: int,
        patch_count: int,
        block_rows: int,
        block_columns: int,
        endpoint_words: int,
        texel_words: int,
        sharpness: float,
        quantised: int,
        blocks: wp.array(dtype=wp.int32),
        colours: wp.array(dtype=wp.float32),
        endpoints: wp.array(dtype=wp.float32),
        metric: wp.array(dtype=wp.float32),
        loss_weights: wp.array(dtype=wp.float32),
        endpoint_table: wp.array(dtype=wp.int32),
        endpoint_grid: wp.array(dtype=wp.float32),
        endpoint_net: wp.array(dtype=wp.float32),
        texel_table: wp.array(dtype=wp.int32),
        texel_grid: wp.array(dtype=wp.float32),
        texel_net: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        endpoint_grid_gradient: wp.array(dtype=wp.float32),
        endpoint_net_gradient: wp.array(dtype=wp.float32),
        texel_grid_gradient: wp.array(dtype=wp.float32),
        texel_net_gradient: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def ntbc_step_kernel(
        first: int,
        parts: int,
        patch_count: int,
        block_rows: int,
        block_columns: int,
        endpoint_words: int,
        texel_words: int,
        sharpness: float,
        quantised: int,
        blocks: wp.array(dtype=wp.int32),
        colours: wp.array(dtype=wp.float32),
        endpoints: wp.array(dtype=wp.float32),
        metric: wp.array(dtype=wp.float32),
        loss_weights: wp.array(dtype=wp.float32),
        endpoint_table: wp.array(dtype=wp.int32),
        endpoint_grid: wp.array(dtype=wp.float32),
        endpoint_net: wp.array(dtype=wp.float32),
        texel_table: wp.array(dtype=wp.int32),
        texel_grid: wp.array(dtype=wp.float32),
        texel_net: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        endpoint_grid_gradient: wp.array(dtype=wp.float32),
        endpoint_net_gradient: wp.array(dtype=wp.float32),
        texel_grid_gradient: wp.array(dtype=wp.float32),
        texel_net_gradient: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
    ):
        step_part(
            first + wp.tid(), parts, patch_count, block_rows, block_columns, endpoint_words, texel_words, sharpness,
            quantised, blocks, colours, endpoints, metric, loss_weights, endpoint_table, endpoint_grid, endpoint_net,
            texel_table, texel_grid, texel_net, scratch, endpoint_grid_gradient, endpoint_net_gradient,
            texel_grid_gradient, texel_net_gradient, losses,
        )  # fmt: skip

    return ntbc_step_kernel


def make_step_kernel(shape: StepShape):
    """Return the kernel of a training step; one thread is one part, levels may have any size."""
    return _make_kernel(shape.endpoint.layout, shape.texel.layout, shape.planes, shape.naive)
