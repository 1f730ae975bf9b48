"""One training step of a reflectance network: gathers, layers, loss and all gradients in one pass (NeuBRDF Eq. 3, 4).

The network's input is the concatenation of *groups*. Group g is a weighted sum of ``taps`` rows of ``width`` numbers
out of a table: the corners of a HEALPix pixel for either direction, the texels of a footprint for a neural texture.
Which rows, and their weights, come with the samples; so any pixelation of the sphere is trained by the same kernel.

The output y stands for the reflectance f = exp(y) − 1, and the loss of a sample and channel is the Charbonnier of
g(f cosθ_i) − target, g(x) = log(1 + s·x) (see :class:`warp_neumat.training.losses.LogCosine`).

A *patch* of :data:`PATCH` samples goes from gathers to gradients in a scratch that stays in the core's cache; rows (one
sample's units) lie contiguous, so that gathered rows, layers and the transposed products of the backward pass are all
one matrix product in registers, 4 rows by 16 columns. Gradients are summed in one buffer per *part*: a part is a fixed
share of the patches in a fixed order, so the same number of parts gives the same bits.

Parameters are packed as :class:`StepShape` says. CPU only: on CUDA the plain torch forward of the model is trained.
"""

import dataclasses
import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.neubrdf import LOG_LIMIT
from warp_neumat.kernels.row_products import VECTORS, padded, product

PATCH = 64
"""Samples that go through the network at once: their activations (80 kB at 32→64→64→3) stay in second-level cache."""


@dataclasses.dataclass(frozen=True)
class StepShape:
    """What a training kernel is compiled for.

    ``net`` is, for every hidden layer, its bias [H] and transposed weights [inputs, H], inputs padded with rows that
    nothing reads; then the output's bias [3] and weights [3, H]. Hidden widths are multiples of 8.
    """

    groups: tuple[tuple[int, int], ...]
    """(width, taps) of every group of inputs."""
    hidden: tuple[int, ...]

    @property
    def inputs(self) -> int:
        """Inputs of the network."""
        return sum(width for width, _ in self.groups)

    @property
    def taps(self) -> int:
        """Rows that a sample gathers."""
        return sum(taps for _, taps in self.groups)

    @property
    def rows(self) -> tuple[int, ...]:
        """Padded widths from the input to the last hidden layer."""
        return (padded(self.inputs), *self.hidden)

    @property
    def offsets(self) -> tuple[tuple[int, int], ...]:
        """(bias, weights) of every layer in ``net``, the output last."""
        found, at = [], 0
        for width, out in zip(self.rows, self.hidden, strict=False):
            found.append((at, at + out))
            at += out + width * out
        return (*found, (at, at + 3))

    @property
    def weights(self) -> int:
        """Length of ``net``."""
        return self.offsets[-1][1] + 3 * self.hidden[-1]

    @property
    def scratch(self) -> int:
        """Float32 words of scratch a part needs."""
        transposed = sum(a * b for a, b in zip(self.rows, self.hidden, strict=False))
        return 2 * PATCH * sum(self.rows) + 4 * PATCH + transposed + 64

    @property
    def flops(self) -> int:
        """Operations of the matrix products of one sample, forward and backward, as executed."""
        products = sum(a * b for a, b in zip(self.rows, self.hidden, strict=False)) + 3 * self.hidden[-1]
        return 6 * products


_HEAD = """
enum { L = %(L)d };
const float* const net = weights.data;
float* const gw = weight_gradient.data + (long long)part * %(NW)d;
float* const gt = table_gradient.data + (long long)part * table_size;
auto root = [](V x) { V y; for (int i = 0; i < 8; ++i) y[i] = __builtin_sqrtf(x[i]); return y; };
// e^x for x in [-80, 17]: 2^n times the minimax polynomial of kernels/approx.py.
auto exponential = [](V x) {
    V t = x * 1.4426950408889634f;
    const I8 low = t < -120.0f; t = (V)(((I8)t & ~low) | ((I8)(V{} - 120.0f) & low));
    I8 n = __builtin_convertvector(t + 1024.5f, I8) - 1024;
    const V f = t - __builtin_convertvector(n, V);
    V p = f * 1.534581182e-4f + 1.339993122e-3f; p = p * f + 9.618488958e-3f; p = p * f + 5.550328777e-2f;
    p = p * f + 2.402264689e-1f; p = p * f + 6.931472057e-1f; p = p * f + 1.0f;
    return p * (V)((n + 127) << 23);
};
// log(1 + x) for x >= 0: exponent, and 2 atanh(s) of the mantissa; what rounding 1 + x lost is put back.
auto log1p = [](V x) {
    const V u = x + 1.0f;
    const I8 bits = (I8)u, n = (bits - 0x3f3504f3) >> 23;
    const V m = (V)(bits - (n << 23)), f = m - 1.0f, s = f / (m + 1.0f), z = s * s;
    V p = z * 0.1111111111f + 0.1428571429f; p = p * z + 0.2f; p = p * z + 0.3333333333f;
    p = 2.0f * s + 2.0f * s * z * p;
    return p + __builtin_convertvector(n, V) * 0.6931471806f + (x - (u - 1.0f)) / u;
};
"""


def _cpu_code(shape: StepShape) -> str:
    rows, hidden, last = shape.rows, shape.hidden, shape.hidden[-1]
    depth = len(hidden)
    text = [VECTORS, _HEAD % {"L": PATCH, "NW": shape.weights}]
    text.append(f"float* at = scratch.data + (long long)part * {shape.scratch};")
    text.append("at += (16 - ((unsigned long long)at / 4) % 16) % 16;")
    for n, width in enumerate(rows):
        text.append(f"float* const A{n} = at; at += {PATCH * width}; float* const D{n} = at; at += {PATCH * width};")
    text.append("float* const Y = at; at += 4 * L;")
    # The backward pass multiplies by the transposed matrices.
    for n in range(depth):
        weights = shape.offsets[n][1]
        text.append(f"float* const T{n} = at; at += {rows[n] * hidden[n]};")
        text.append(
            f"for (int i = 0; i < {rows[n]}; ++i) for (int o = 0; o < {hidden[n]}; ++o)"
            f" T{n}[o * {rows[n]} + i] = net[{weights} + i * {hidden[n]} + o];"
        )
    text.append("for (int b = part; b < patch_count; b += parts) {")
    text.append(f"const int* const place = corner.data + (long long)b * L * {shape.taps};")
    text.append(f"const float* const share = weight.data + (long long)b * L * {shape.taps};")
    text.append("const float* const cosines = cosine.data + (long long)b * L;")
    text.append("const float* const wanted = target.data + (long long)b * L * 3;")
    # Gathers.
    text.append("for (int l = 0; l < L; ++l) {")
    text.append(f"float* const x = A0 + l * {rows[0]};")
    at = tap = 0
    for g, (width, taps) in enumerate(shape.groups):
        text.append(f"{{ const float* const rows = table.data + offsets.data[{g}];")
        text.append(f"float s[{width}]; for (int j = 0; j < {width}; ++j) s[j] = 0.0f;")
        text.append(f"for (int t = 0; t < {taps}; ++t) {{ const float c = share[l * {shape.taps} + {tap} + t];")
        text.append(f"const float* const p = rows + (long long)place[l * {shape.taps} + {tap} + t] * {width};")
        text.append(f"for (int j = 0; j < {width}; ++j) s[j] += c * p[j]; }}")
        text.append(f"for (int j = 0; j < {width}; ++j) x[{at} + j] = s[j]; }}")
        at, tap = at + width, tap + taps
    text.append(f"for (int j = {at}; j < {rows[0]}; ++j) x[j] = 0.0f; }}")
    # Forward.
    for n in range(depth):
        bias, weights = shape.offsets[n]
        text.append(
            product(
                a=f"A{n}", row=rows[n], step=1, rows="L", depth=rows[n], b=f"(net + {weights})", stride=hidden[n],
                columns=hidden[n], out=f"A{n + 1}", width=hidden[n], start=f"(net + {bias})", relu=True,
            )
        )  # fmt: skip
    bias, weights = shape.offsets[-1]
    text.append(f"""
    for (int l = 0; l < L; ++l) {{
        V s0 = Z, s1 = Z, s2 = Z; const float* const h = A{depth} + l * {last}; const float* const w = net + {weights};
        for (int j = 0; j < {last}; j += 8) {{ const V v = *(const V*)(h + j); s0 += v * *(const V*)(w + j);
            s1 += v * *(const V*)(w + {last} + j); s2 += v * *(const V*)(w + {2 * last} + j); }}
        Y[l] = sum8(s0) + net[{bias}]; Y[L + l] = sum8(s1) + net[{bias + 1}]; Y[2 * L + l] = sum8(s2) + net[{bias + 2}];
    }}
    // Loss, and in place of y its derivative.
    V total = Z;
    float* const error = errors.data + (long long)b * L;
    for (int l = 0; l < L; l += 8) *(V*)(error + l) = Z;
    for (int c = 0; c < 3; ++c) for (int l = 0; l < L; l += 8) {{
        V y = *(const V*)(Y + c * L + l), t;
        for (int i = 0; i < 8; ++i) t[i] = wanted[3 * (l + i) + c];
        const V slope = sharpness * *(const V*)(cosines + l);
        const I8 high = y > {LOG_LIMIT}f;
        y = select(high, Z + {LOG_LIMIT}f, y);
        const V e = exponential(y), x = slope * (e - 1.0f);
        const I8 positive = x > 0.0f;
        const V up = select(positive, x, Z);
        const V r = log1p(up) + (x - up) - t;
        const V size = root(r * r + softness * softness);
        total += size;
        *(V*)(error + l) += r * r;
        V d = r / size * gain * slope * e / (1.0f + up);
        *(V*)(Y + c * L + l) = select(high, Z, d);
    }}
    losses.data[b] = sum8(total) / (3.0f * L);
    if (!backward) continue;
    // Output layer backwards.
    for (int c = 0; c < 3; ++c) {{
        V s = Z; for (int l = 0; l < L; l += 8) s += *(const V*)(Y + c * L + l);
        gw[{bias} + c] += sum8(s);
    }}
    for (int j = 0; j < {last}; j += 8) {{
        V s0 = Z, s1 = Z, s2 = Z;
        const V w0 = *(const V*)(net + {weights} + j), w1 = *(const V*)(net + {weights + last} + j),
            w2 = *(const V*)(net + {weights + 2 * last} + j);
        for (int l = 0; l < L; ++l) {{
            const V h = *(const V*)(A{depth} + l * {last} + j);
            s0 += h * Y[l]; s1 += h * Y[L + l]; s2 += h * Y[2 * L + l];
            *(V*)(D{depth} + l * {last} + j) = select(h > 0.0f, w0 * Y[l] + w1 * Y[L + l] + w2 * Y[2 * L + l], Z);
        }}
        float* const g = gw + {weights} + j;
        *(V*)g += s0; *(V*)(g + {last}) += s1; *(V*)(g + {2 * last}) += s2;
    }}
    """)
    for n in reversed(range(depth)):
        bias, weights = shape.offsets[n]
        text.append(f"for (int o = 0; o < {hidden[n]}; o += 8) {{ V s = Z; for (int l = 0; l < L; ++l)"
                    f" s += *(const V*)(D{n + 1} + l * {hidden[n]} + o); *(V*)(gw + {bias} + o) += s; }}")  # fmt: skip
        text.append(
            product(
                a=f"A{n}", row=1, step=rows[n], rows=rows[n], depth="L", b=f"D{n + 1}", stride=hidden[n],
                columns=hidden[n], out=f"(gw + {weights})", width=hidden[n], add=True,
            )
        )  # fmt: skip
        text.append(
            product(
                a=f"D{n + 1}", row=hidden[n], step=1, rows="L", depth=hidden[n], b=f"T{n}", stride=rows[n],
                columns=rows[n], out=f"D{n}", width=rows[n], mask=f"A{n}" if n else None,
            )
        )  # fmt: skip
    # Scatter.
    text.append(f"for (int l = 0; l < L; ++l) {{ const float* const d = D0 + l * {rows[0]};")
    at = tap = 0
    for g, (width, taps) in enumerate(shape.groups):
        text.append(f"{{ float* const rows = gt + offsets.data[{g}];")
        text.append(f"for (int t = 0; t < {taps}; ++t) {{ const float c = share[l * {shape.taps} + {tap} + t];")
        text.append(f"float* const p = rows + (long long)place[l * {shape.taps} + {tap} + t] * {width};")
        text.append(f"for (int j = 0; j < {width}; ++j) p[j] += c * d[{at} + j]; }} }}")
        at, tap = at + width, tap + taps
    text.append("} }")
    return "\n".join(text)


@functools.cache
def make_step_kernel(shape: StepShape):
    """Return the kernel of a training step; one thread is one part."""

    @wp.func_native(_cpu_code(shape))
    def step_part(
        part: int,
        parts: int,
        patch_count: int,
        table_size: int,
        backward: int,
        gain: float,
        sharpness: float,
        softness: float,
        corner: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=wp.float32),
        cosine: wp.array(dtype=wp.float32),
        target: wp.array(dtype=wp.float32),
        offsets: wp.array(dtype=wp.int32),
        table: wp.array(dtype=wp.float32),
        weights: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        table_gradient: wp.array(dtype=wp.float32),
        weight_gradient: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
        errors: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def brdf_step_kernel(
        first: int,
        parts: int,
        patch_count: int,
        table_size: int,
        backward: int,
        gain: float,
        sharpness: float,
        softness: float,
        corner: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=wp.float32),
        cosine: wp.array(dtype=wp.float32),
        target: wp.array(dtype=wp.float32),
        offsets: wp.array(dtype=wp.int32),
        table: wp.array(dtype=wp.float32),
        weights: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        table_gradient: wp.array(dtype=wp.float32),
        weight_gradient: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
        errors: wp.array(dtype=wp.float32),
    ):
        step_part(
            first + wp.tid(), parts, patch_count, table_size, backward, gain, sharpness, softness, corner, weight,
            cosine, target, offsets, table, weights, scratch, table_gradient, weight_gradient, losses, errors,
        )  # fmt: skip

    return brdf_step_kernel
