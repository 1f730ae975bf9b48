"""One training step of a BTF network: fetches, networks, distillation loss and all gradients in one pass.

MobileVR §4.1 and Eq. 3–5. A sample is a *quad*: four places around a centre that share their directions. The coarse
network, where there is one, runs once for a quad and the fine one four times; without it the fine network gets the
directions itself. The loss of a quad is

    mean |y − y_gt| + σ · mean |y − y_t| + λ₁ · mean (z₁ − h₁)² + λ₂ · mean (z₂ − h₂)²

y_t is the teacher's output; z₁ are the latents (single level: the hidden layer in the middle), z₂ the last hidden
layer, h what the linear maps make of the teacher's. In place of z the kernel can leave z − h, which is all that the
gradients of those maps need.

A *patch* of :data:`QUADS` quads goes from fetches to gradients in a scratch that stays in the core's cache. Gradients
are summed in one buffer per *part*, a fixed share of the patches in a fixed order, so the same number of parts gives
the same bits. CPU only: on CUDA the plain torch forward of the model is trained.
"""

import dataclasses
import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.row_products import VECTORS, padded, product

QUADS = 16
"""Quads that go through the networks at once: activations of 128-wide layers (0.3 MB) stay in second-level cache."""

TEXELS = 4 * QUADS

FORWARD, EXPORT, TRAIN = 0, 1, 2
"""What a step does: outputs and losses; also z₁ and z₂; also the gradients, with z − h in place of z."""


@dataclasses.dataclass(frozen=True)
class StepShape:
    """What a training kernel is compiled for.

    Packed weights are, for every layer of the coarse and then of the fine network, its bias [H] and transposed weights
    [inputs, H], both padded to multiples of 8 with zeros; of the output its bias [3] and weights [3, H]. Inputs are
    angles, then features; of a fine network below a coarse one latents, then features.
    """

    angles: int
    """Numbers that say the directions: 6, or 9 with the half vector."""
    channels: int
    """Of the fine texture."""
    hidden: tuple[int, ...]
    """Widths of the fine network's hidden layers."""
    coarse_channels: int = 0
    """Of the coarse texture; 0 = there is no coarse network."""
    coarse: tuple[int, ...] = ()
    """Widths of the coarse network's layers, the latents last."""
    activation: str = "hardswish"
    """``"hardswish"`` or ``"relu"``."""

    @property
    def coarse_rows(self) -> tuple[int, ...]:
        """Padded widths from the coarse input to the latents; empty without a coarse network."""
        return (padded(self.angles + self.coarse_channels), *map(padded, self.coarse)) if self.coarse else ()

    @property
    def head(self) -> int:
        """Inputs of the fine network before the features."""
        return self.coarse[-1] if self.coarse else self.angles

    @property
    def fine_rows(self) -> tuple[int, ...]:
        """Padded widths from the fine input to the last hidden layer."""
        return (padded(self.head + self.channels), *map(padded, self.hidden))

    @property
    def middle(self) -> int:
        """Number of the fine activation that is z₁ in a single-level network, from 1."""
        return (len(self.hidden) + 1) // 2

    @property
    def hints(self) -> tuple[int, int, int]:
        """(rows of z₁ for a quad, its padded width, the padded width of z₂)."""
        if self.coarse:
            return 1, self.coarse_rows[-1], self.fine_rows[-1]
        return 4, self.fine_rows[self.middle], self.fine_rows[-1]

    @property
    def layers(self) -> tuple[tuple[str, int, int, int, int], ...]:
        """(network, inputs, outputs, bias, weights) of every hidden layer, unpadded widths and offsets, in order."""
        found, at = [], 0
        for name, width, outs in (("coarse", self.angles + self.coarse_channels, self.coarse),
                                  ("fine", self.head + self.channels, self.hidden)):  # fmt: skip
            for out in outs:
                found.append((name, width, out, at, at + padded(out)))
                at += padded(out) + padded(width) * padded(out)
                width = out
        return tuple(found)

    @property
    def output(self) -> tuple[int, int]:
        """Offsets of the output's bias and weights."""
        _, width, out, _, weights = self.layers[-1]
        at = weights + padded(width) * padded(out)
        return at, at + 3

    @property
    def weights(self) -> int:
        """Length of the packed weights."""
        return self.output[1] + 3 * self.fine_rows[-1]

    @property
    def scratch(self) -> int:
        """Float32 words of scratch a part needs."""
        activations = 3 * QUADS * sum(self.coarse_rows) + 3 * TEXELS * sum(
            self.fine_rows
        )  # values, derivatives, slopes
        return activations + 3 * TEXELS + 8 * (QUADS + TEXELS) + self.weights + 64

    @property
    def products(self) -> int:
        """Multiply-adds of the layers of one quad, forward, unpadded."""
        rows = {"coarse": 1, "fine": 4}
        return sum(rows[name] * i * o for name, i, o, _, _ in self.layers) + 12 * self.hidden[-1]


_FETCH = """
auto fetch = [&](const int* level, int channels, float u, float v, int* tap, float* share) {
    const int first = level[0], w = level[1], h = level[2];
    u = (u - __builtin_floorf(u)) * w - 0.5f; v = (v - __builtin_floorf(v)) * h - 0.5f;
    const float x0 = __builtin_floorf(u), y0 = __builtin_floorf(v), fx = u - x0, fy = v - y0;
    int xa = (int)x0, ya = (int)y0;
    xa = xa < 0 ? xa + w : xa; ya = ya < 0 ? ya + h : ya;
    const int xb = xa + 1 == w ? 0 : xa + 1, yb = ya + 1 == h ? 0 : ya + 1;
    tap[0] = first + (ya * w + xa) * channels; tap[1] = first + (ya * w + xb) * channels;
    tap[2] = first + (yb * w + xa) * channels; tap[3] = first + (yb * w + xb) * channels;
    share[0] = (1.0f - fx) * (1.0f - fy); share[1] = fx * (1.0f - fy);
    share[2] = (1.0f - fx) * fy; share[3] = fx * fy;
};
"""


def _gather(channels: int, target: str) -> str:
    return (
        f"{{ float s[{channels}]; for (int j = 0; j < {channels}; ++j) s[j] = 0.0f;"
        f" for (int t = 0; t < 4; ++t) {{ const float c = share[t]; const float* const p = table.data + tap[t];"
        f" for (int j = 0; j < {channels}; ++j) s[j] += c * p[j]; }}"
        f" for (int j = 0; j < {channels}; ++j) {target}[j] = s[j]; }}"
    )


def _scatter(channels: int, source: str) -> str:
    return (
        f"for (int t = 0; t < 4; ++t) {{ const float c = share[t]; float* const p = gt + tap[t];"
        f" for (int j = 0; j < {channels}; ++j) p[j] += c * {source}[j]; }}"
    )


def _forward(prefix: str, rows, count: int, layers, activation: str) -> str:
    text = []
    for n, (_, _, _, bias, weights) in enumerate(layers):
        text.append(
            product(
                a=f"{prefix}A{n}", row=rows[n], step=1, rows=count, depth=rows[n], b=f"(net + {weights})",
                stride=rows[n + 1], columns=rows[n + 1], out=f"{prefix}A{n + 1}", width=rows[n + 1],
                start=f"(net + {bias})", relu=activation == "relu",
                hardswish=f"{prefix}S{n + 1}" if activation == "hardswish" else None,
            )
        )  # fmt: skip
    return "\n".join(text)


def _backward(prefix: str, rows, count: int, layers, first: int, end: int, activation: str) -> str:
    """C++ of gradients by layers ``end`` − 1 … ``first``, where D{end} is by the sums; leaves D{first}."""
    text = []
    for n in reversed(range(first, end)):
        _, _, _, bias, weights = layers[n]
        out = rows[n + 1]
        text.append(
            f"for (int o = 0; o < {out}; o += 8) {{ V s = Z; for (int l = 0; l < {count}; ++l)"
            f" s += *(const V*)({prefix}D{n + 1} + l * {out} + o); *(V*)(gw + {bias} + o) += s; }}"
        )
        text.append(
            product(
                a=f"{prefix}A{n}", row=1, step=rows[n], rows=rows[n], depth=count, b=f"{prefix}D{n + 1}", stride=out,
                columns=out, out=f"(gw + {weights})", width=out, add=True,
            )
        )  # fmt: skip
        text.append(
            product(
                a=f"{prefix}D{n + 1}", row=out, step=1, rows=count, depth=out, b=f"{prefix}T{n}", stride=rows[n],
                columns=rows[n], out=f"{prefix}D{n}", width=rows[n],
                mask=f"{prefix}A{n}" if n and activation == "relu" else None,
                slope=f"{prefix}S{n}" if n and activation == "hardswish" else None,
            )
        )  # fmt: skip
    return "\n".join(text)


def _by_sum(activation: str, prefix: str, n: int, at: str, value: str) -> str:
    """C++ of ``value``, a derivative by layer n's activations, times theirs by its sums."""
    if activation == "relu":
        return f"select(*(const V*)({prefix}A{n} + {at}) > 0.0f, {value}, Z)"
    return f"({value}) * *(const V*)({prefix}S{n} + {at})"


def _hint(number: int, activations: str, size: int) -> str:
    """C++ that leaves z, or z − h and its loss, in ``latent{number}``, and defines the slope of that loss."""
    return f"""
    const float slope{number} = mode == {TRAIN} ? 2.0f * lambda{number} * hint_gain{number} : 0.0f;
    float* const z{number} = latent{number}.data + (long long)b * {size};
    if (mode == {EXPORT} || slope{number} > 0.0f) {{
        const float* const h = hint{number}.data + (long long)b * {size};
        V sum = Z;
        for (int j = 0; j < {size}; j += 8) {{
            V e = *(const V*)({activations} + j);
            if (slope{number} > 0.0f) e -= *(const V*)(h + j);
            *(V*)(z{number} + j) = e;
            sum += e * e;
        }}
        if (slope{number} > 0.0f) distilled += lambda{number} * sum8(sum) / {size};
    }}
    """


def _cpu_code(shape: StepShape) -> str:
    coarse, fine = shape.coarse_rows, shape.fine_rows
    above = [layer for layer in shape.layers if layer[0] == "coarse"]
    below = [layer for layer in shape.layers if layer[0] == "fine"]
    last, depth, head = fine[-1], len(fine) - 1, shape.head
    text = [VECTORS, _FETCH]
    text.append(
        "const float* const net = weights.data;"
        f"float* const gw = weight_gradient.data + (long long)part * {shape.weights};"
    )
    text.append("float* const gt = table_gradient.data + (long long)part * table_size;")
    text.append(f"float* at = scratch.data + (long long)part * {shape.scratch};")
    text.append("at += (16 - ((unsigned long long)at / 4) % 16) % 16;")
    for prefix, rows, count in (("c", coarse, QUADS), ("f", fine, TEXELS)):
        for n, width in enumerate(rows):
            text.append(
                f"float* const {prefix}A{n} = at; at += {count * width};"
                f"float* const {prefix}D{n} = at; at += {count * width};"
                f"float* const {prefix}S{n} = at; at += {count * width};"
            )
    text.append(f"float* const Y = at; at += {3 * TEXELS};")
    text.append(f"int* const ctap = (int*)at; at += {4 * QUADS}; float* const cshare = at; at += {4 * QUADS};")
    text.append(f"int* const ftap = (int*)at; at += {4 * TEXELS}; float* const fshare = at; at += {4 * TEXELS};")
    # The backward pass multiplies by the transposed matrices.
    for prefix, rows, layers in (("c", coarse, above), ("f", fine, below)):
        for n, (_, _, _, _, weights) in enumerate(layers):
            text.append(f"float* const {prefix}T{n} = at; at += {rows[n] * rows[n + 1]};")
            text.append(
                f"for (int i = 0; i < {rows[n]}; ++i) for (int o = 0; o < {rows[n + 1]}; ++o)"
                f" {prefix}T{n}[o * {rows[n]} + i] = net[{weights} + i * {rows[n + 1]} + o];"
            )
    text.append("for (int b = part; b < patch_count; b += parts) {")
    text.append("float error = 0.0f, distilled = 0.0f;")
    # Fetches.
    text.append(f"for (int q = 0; q < {QUADS}; ++q) {{ const long long quad = (long long)b * {QUADS} + q;")
    text.append(
        f"const float* const a = angles.data + quad * {shape.angles}; const float* const p = place.data + quad * 4;"
    )
    text.append("const int level = (int)p[3];")
    if shape.coarse:
        text.append(
            "{ int* const tap = ctap + 4 * q; float* const share = cshare + 4 * q;"
            f"float* const x = cA0 + q * {coarse[0]};"
        )
        text.append(f"fetch(levels.data + 3 * (level_count + level), {shape.coarse_channels}, p[0], p[1], tap, share);")
        text.append(f"for (int j = 0; j < {shape.angles}; ++j) x[j] = a[j];")
        text.append(_gather(shape.coarse_channels, f"(x + {shape.angles})"))
        text.append(f"for (int j = {shape.angles + shape.coarse_channels}; j < {coarse[0]}; ++j) x[j] = 0.0f; }}")
    text.append(
        "for (int k = 0; k < 4; ++k) { const int row = 4 * q + k; const int* const level_of = levels.data + 3 * level;"
    )
    text.append(
        "const float du = (k & 1 ? 0.5f : -0.5f) * p[2] / level_of[1];"
        "const float dv = (k & 2 ? 0.5f : -0.5f) * p[2] / level_of[2];"
    )
    text.append(
        "int* const tap = ftap + 4 * row; float* const share = fshare + 4 * row;"
        f"float* const x = fA0 + row * {fine[0]};"
    )
    text.append(f"fetch(level_of, {shape.channels}, p[0] + du, p[1] + dv, tap, share);")
    if not shape.coarse:
        text.append(f"for (int j = 0; j < {shape.angles}; ++j) x[j] = a[j];")
    text.append(_gather(shape.channels, f"(x + {head})"))
    text.append(f"for (int j = {head + shape.channels}; j < {fine[0]}; ++j) x[j] = 0.0f; }} }}")
    # Networks.
    if shape.coarse:
        text.append(_forward("c", coarse, QUADS, above, shape.activation))
        text.append(
            f"for (int r = 0; r < {TEXELS}; ++r) for (int j = 0; j < {head}; ++j)"
            f" fA0[r * {fine[0]} + j] = cA{len(above)}[(r >> 2) * {coarse[-1]} + j];"
        )
    text.append(_forward("f", fine, TEXELS, below, shape.activation))
    bias, weights = shape.output
    text.append(f"""
    for (int l = 0; l < {TEXELS}; ++l) {{
        V s0 = Z, s1 = Z, s2 = Z; const float* const h = fA{depth} + l * {last}; const float* const w = net + {weights};
        for (int j = 0; j < {last}; j += 8) {{ const V v = *(const V*)(h + j); s0 += v * *(const V*)(w + j);
            s1 += v * *(const V*)(w + {last} + j); s2 += v * *(const V*)(w + {2 * last} + j); }}
        Y[3 * l] = sum8(s0) + net[{bias}]; Y[3 * l + 1] = sum8(s1) + net[{bias + 1}];
        Y[3 * l + 2] = sum8(s2) + net[{bias + 2}];
    }}
    // Losses; the derivative takes the place of y.
    {{
        const long long first = (long long)b * {3 * TEXELS};
        const V one = Z + 1.0f;
        auto sign = [&](V r) {{ return select(r > 0.0f, one, select(r < 0.0f, -one, Z)); }};
        auto size = [&](V r) {{ return select(r < 0.0f, -r, r); }};
        V mistake = Z, strange = Z;
        for (int j = 0; j < {3 * TEXELS}; j += 8) {{
            const V y = *(const V*)(Y + j), r = y - *(const V*)(target.data + first + j);
            *(V*)(output.data + first + j) = y;
            mistake += size(r);
            V d = sign(r);
            if (sigma > 0.0f) {{
                const V t = y - *(const V*)(teacher.data + first + j); strange += size(t); d += sigma * sign(t);
            }}
            *(V*)(Y + j) = gain * d;
        }}
        error = sum8(mistake) / {3 * TEXELS}; distilled = sigma * sum8(strange) / {3 * TEXELS};
    }}
    """)
    text.append(_hint(1, f"cA{len(above)}", QUADS * coarse[-1]) if shape.coarse else
                _hint(1, f"fA{shape.middle}", TEXELS * fine[shape.middle]))  # fmt: skip
    text.append(_hint(2, f"fA{depth}", TEXELS * last))
    text.append("losses.data[2 * b] = error; losses.data[2 * b + 1] = distilled;")
    text.append(f"if (mode != {TRAIN}) continue;")
    # Output layer backwards.
    text.append(f"""
    {{
        float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f;
        for (int l = 0; l < {TEXELS}; ++l) {{ s0 += Y[3 * l]; s1 += Y[3 * l + 1]; s2 += Y[3 * l + 2]; }}
        gw[{bias}] += s0; gw[{bias + 1}] += s1; gw[{bias + 2}] += s2;
    }}
    for (int j = 0; j < {last}; j += 8) {{
        V s0 = Z, s1 = Z, s2 = Z;
        const V w0 = *(const V*)(net + {weights} + j), w1 = *(const V*)(net + {weights + last} + j),
            w2 = *(const V*)(net + {weights + 2 * last} + j);
        for (int l = 0; l < {TEXELS}; ++l) {{
            const V h = *(const V*)(fA{depth} + l * {last} + j);
            const float y0 = Y[3 * l], y1 = Y[3 * l + 1], y2 = Y[3 * l + 2];
            s0 += h * y0; s1 += h * y1; s2 += h * y2;
            V d = w0 * y0 + w1 * y1 + w2 * y2;
            if (slope2 > 0.0f) d += slope2 * *(const V*)(z2 + l * {last} + j);
            *(V*)(fD{depth} + l * {last} + j) = {_by_sum(shape.activation, "f", depth, f"l * {last} + j", "d")};
        }}
        float* const g = gw + {weights} + j;
        *(V*)g += s0; *(V*)(g + {last}) += s1; *(V*)(g + {2 * last}) += s2;
    }}
    """)
    if shape.coarse:
        text.append(_backward("f", fine, TEXELS, below, 0, depth, shape.activation))
        wide, end = coarse[-1], len(above)
        text.append(f"""
        for (int q = 0; q < {QUADS}; ++q) {{
            alignas(32) float s[{wide}];
            for (int j = 0; j < {wide}; ++j) s[j] = 0.0f;
            for (int k = 0; k < 4; ++k) for (int j = 0; j < {head}; ++j) s[j] += fD0[(4 * q + k) * {fine[0]} + j];
            for (int j = 0; j < {wide}; j += 8) {{
                V d = *(const V*)(s + j);
                if (slope1 > 0.0f) d += slope1 * *(const V*)(z1 + q * {wide} + j);
                *(V*)(cD{end} + q * {wide} + j) = {_by_sum(shape.activation, "c", end, f"q * {wide} + j", "d")};
            }}
        }}
        """)
        text.append(_backward("c", coarse, QUADS, above, 0, end, shape.activation))
    else:
        wide = fine[shape.middle]
        text.append(_backward("f", fine, TEXELS, below, shape.middle, depth, shape.activation))
        own = _by_sum(shape.activation, "f", shape.middle, "j", "slope1 * *(const V*)(z1 + j)")
        text.append(f"""
        if (slope1 > 0.0f) for (int j = 0; j < {TEXELS * wide}; j += 8) *(V*)(fD{shape.middle} + j) += {own};
        """)
        text.append(_backward("f", fine, TEXELS, below, 0, shape.middle, shape.activation))
    # Scatter.
    text.append(
        f"for (int r = 0; r < {TEXELS}; ++r) {{ const int* const tap = ftap + 4 * r;"
        "const float* const share = fshare + 4 * r;"
    )
    text.append(f"const float* const d = fD0 + r * {fine[0]} + {head}; {_scatter(shape.channels, 'd')} }}")
    if shape.coarse:
        text.append(
            f"for (int q = 0; q < {QUADS}; ++q) {{ const int* const tap = ctap + 4 * q;"
            "const float* const share = cshare + 4 * q;"
        )
        text.append(
            f"const float* const d = cD0 + q * {coarse[0]} + {shape.angles}; {_scatter(shape.coarse_channels, 'd')} }}"
        )
    text.append("}")
    return "\n".join(text)


@functools.cache
def make_step_kernel(shape: StepShape):
    """Return the kernel of a training step; one thread is one part."""

    @wp.func_native(_cpu_code(shape))
    def step_part(
        part: int,
        parts: int,
        patch_count: int,
        level_count: int,
        table_size: int,
        mode: int,
        gain: float,
        hint_gain1: float,
        hint_gain2: float,
        sigma: float,
        lambda1: float,
        lambda2: float,
        angles: wp.array(dtype=wp.float32),
        place: wp.array(dtype=wp.float32),
        target: wp.array(dtype=wp.float32),
        teacher: wp.array(dtype=wp.float32),
        hint1: wp.array(dtype=wp.float32),
        hint2: wp.array(dtype=wp.float32),
        levels: wp.array(dtype=wp.int32),
        table: wp.array(dtype=wp.float32),
        weights: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        table_gradient: wp.array(dtype=wp.float32),
        weight_gradient: wp.array(dtype=wp.float32),
        output: wp.array(dtype=wp.float32),
        latent1: wp.array(dtype=wp.float32),
        latent2: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def btf_step_kernel(
        first: int,
        parts: int,
        patch_count: int,
        level_count: int,
        table_size: int,
        mode: int,
        gain: float,
        hint_gain1: float,
        hint_gain2: float,
        sigma: float,
        lambda1: float,
        lambda2: float,
        angles: wp.array(dtype=wp.float32),
        place: wp.array(dtype=wp.float32),
        target: wp.array(dtype=wp.float32),
        teacher: wp.array(dtype=wp.float32),
        hint1: wp.array(dtype=wp.float32),
        hint2: wp.array(dtype=wp.float32),
        levels: wp.array(dtype=wp.int32),
        table: wp.array(dtype=wp.float32),
        weights: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        table_gradient: wp.array(dtype=wp.float32),
        weight_gradient: wp.array(dtype=wp.float32),
        output: wp.array(dtype=wp.float32),
        latent1: wp.array(dtype=wp.float32),
        latent2: wp.array(dtype=wp.float32),
        losses: wp.array(dtype=wp.float32),
    ):
        step_part(
            first + wp.tid(), parts, patch_count, level_count, table_size, mode, gain, hint_gain1, hint_gain2, sigma,
            lambda1, lambda2, angles, place, target, teacher, hint1, hint2, levels, table, weights, scratch,
            table_gradient, weight_gradient, output, latent1, latent2, losses,
        )  # fmt: skip

    return btf_step_kernel
