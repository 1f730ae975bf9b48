"""A network of NTBC: a pyramid of feature grids and the layers behind it, as C++ for ``wp.func_native`` (NTBC §3.4).

A place (u, v) in [0, 1)² is looked up bilinearly in every level; a level of (width, height) has its vertices at
((i + 0.5) / width, (j + 0.5) / height) and wraps around. The features of all levels, coarsest first, are the inputs of
hidden layers with selu and an output layer with sigmoid.

Grids lie in one flat float32 array, level by level, [height][width][features]. ``net`` is, for every layer, its bias
[out] and transposed weights [in][out], with widths padded to multiples of 8 by zeros (whose gradients are 0). How fine
the levels are is run-time data, :meth:`NetworkShape.table`, so that kernels are compiled once per :class:`Layout`.

:class:`NetworkCode` writes one *patch* of rows (one place's units are a row) through the network and back: gather,
forward, backward and scatter. Where the rows' places come from is a *visit*: blocks, their texels, or any positions.
"""

import dataclasses

import numpy as np

from warp_neumat.kernels.row_products import EXPONENTIAL, VECTORS, padded, product

SELU_SCALE, SELU_ALPHA = 1.0507009873554805, 1.6732632423543772
"""λ and α of selu(x) = λx for x > 0, λα(e^x − 1) below."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a kernel is compiled for: all of :class:`NetworkShape` but how fine its levels are."""

    levels: int
    outputs: int
    hidden: tuple[int, ...] = (64, 64, 64)
    features: int = 2

    def __post_init__(self):
        if self.features not in (1, 2, 4, 8):
            raise ValueError(f"features must be 1, 2, 4 or 8, got {self.features}")
        if min(self.levels, self.outputs, *self.hidden, len(self.hidden)) < 1:
            raise ValueError(f"a network needs levels, outputs and hidden layers of at least 1 unit, got {self}")

    @property
    def inputs(self) -> int:
        """Inputs of the first layer."""
        return self.levels * self.features

    @property
    def widths(self) -> tuple[int, ...]:
        """Units from the input to the output."""
        return (self.inputs, *self.hidden, self.outputs)

    @property
    def rows(self) -> tuple[int, ...]:
        """Padded widths from the input to the output."""
        return tuple(padded(width) for width in self.widths)

    @property
    def offsets(self) -> tuple[tuple[int, int], ...]:
        """(bias, weights) of every layer in ``net``, the output last."""
        found, at = [], 0
        for width, out in zip(self.rows[:-1], self.rows[1:], strict=True):
            found.append((at, at + out))
            at += out + width * out
        return tuple(found)

    @property
    def weights(self) -> int:
        """Length of ``net``."""
        return sum(out + width * out for width, out in zip(self.rows[:-1], self.rows[1:], strict=True))

    def folded(self, net: np.ndarray) -> np.ndarray:
        """Return ``net`` with selu's factors in the weights, for ``NetworkCode.forward(folded=True)``.

        A hidden unit is then :data:`UNIT` / λ times its selu, so that positive numbers pass as they are.
        """
        result, last = np.array(net, np.float32), len(self.offsets) - 1
        for n, (bias, weights) in enumerate(self.offsets):
            end = weights + self.rows[n] * self.rows[n + 1]
            result[bias:weights] *= UNIT if n < last else 1.0
            result[weights:end] *= (SELU_SCALE / UNIT if n else 1.0) * (UNIT if n < last else 1.0)
        return result

    @property
    def flops(self) -> int:
        """Operations of the matrix products of one row forward; backward has twice as many. Padding is not counted."""
        return sum(2 * a * b for a, b in zip(self.widths[:-1], self.widths[1:], strict=True))


@dataclasses.dataclass(frozen=True)
class NetworkShape:
    """Sizes of a network and its grids.

    ``levels`` are (width, height), coarsest first. The rest is :class:`Layout`'s.
    """

    levels: tuple[tuple[int, int], ...]
    outputs: int
    hidden: tuple[int, ...] = (64, 64, 64)
    features: int = 2

    def __post_init__(self):
        if not self.levels or any(len(size) != 2 or min(size) < 1 for size in self.levels):
            raise ValueError(f"levels must be (width, height) of at least 1 each, got {self.levels}")
        _ = self.layout

    @property
    def layout(self) -> Layout:
        """What its kernels are compiled for."""
        return Layout(len(self.levels), self.outputs, self.hidden, self.features)

    @property
    def grid_sizes(self) -> tuple[int, ...]:
        """Float32 words of every level."""
        return tuple(width * height * self.features for width, height in self.levels)

    @property
    def grid_offsets(self) -> tuple[int, ...]:
        """Where every level begins in the grids, in float32 words."""
        return tuple(sum(self.grid_sizes[:k]) for k in range(len(self.levels)))

    @property
    def grid_words(self) -> int:
        """Length of the grids."""
        return sum(self.grid_sizes)

    def table(self) -> np.ndarray:
        """Return (width, height, offset) of every level, [levels, 3] int32: what kernels read."""
        rows = [(*size, at) for size, at in zip(self.levels, self.grid_offsets, strict=True)]
        return np.array(rows, np.int32)

    inputs = property(lambda self: self.layout.inputs)
    rows = property(lambda self: self.layout.rows)
    offsets = property(lambda self: self.layout.offsets)
    weights = property(lambda self: self.layout.weights)
    flops = property(lambda self: self.layout.flops)


_ROOT = (9.999996186e-01, 1.249933908e-01, 7.797165950e-03, 3.147321350e-04, 7.377674023e-06)
"""Polynomial whose eighth power is e^x within 3.1e-6 for -13.86 < x < 0 (least squares reweighed until the worst errors
are equal)."""

UNIT = (SELU_ALPHA**0.125 * _ROOT[4]) ** (8 / 31)
"""What a pre-activation of 1 is in a folded network: so that the polynomial's leading coefficient becomes 1."""

_FOLDED = tuple((UNIT * SELU_ALPHA) ** 0.125 * a / UNIT**k for k, a in enumerate(_ROOT))

TAP = """
// The two vertices around a place in [0, 1) along one axis, and how far the second is weighed.
auto tap = [](double place, int size, int& low, int& high, float& share) {
    const double p = place * size + 0.5;
    const int i = (int)p;
    share = (float)(p - i); low = i ? i - 1 : size - 1; high = i < size ? i : 0;
};
"""
"""tap(place, size, low, high, share), what every look-up in a grid needs."""


def check_outputs(endpoint: NetworkShape, texel: NetworkShape, planes: int, channels: int, naive: bool, names) -> None:
    """Raise a ValueError unless both networks have the outputs that a model's planes need (NTBC §4.1)."""
    expected = (2 * channels, planes if naive else channels)
    if not planes or (endpoint.outputs, texel.outputs) != expected:
        raise ValueError(
            f"endpoint and texel network must have {expected[0]} and {expected[1]} outputs for planes {names}"
            f", got {endpoint.outputs} and {texel.outputs}"
        )


HEAD = (
    VECTORS
    + EXPONENTIAL
    + f"""
auto selu = [&](V x) {{
    V power;
    const V p = exponential_parts(x, {SELU_SCALE * SELU_ALPHA}f, power);
    return (I8)x < 0 ? p * power - {SELU_SCALE * SELU_ALPHA}f : x * {SELU_SCALE}f;
}};
auto folded_selu = [&](V x) {{
    const V k = larger(Z - {13.86 * UNIT}f, x);
    V p = k + {_FOLDED[3]}f; p = p * k + {_FOLDED[2]}f; p = p * k + {_FOLDED[1]}f; p = p * k + {_FOLDED[0]}f;
    p *= p; p *= p;
    return (I8)x < 0 ? p * p - {UNIT * SELU_ALPHA}f : x;
}};
auto selu_slope = [&](V y) {{ return select(y > 0.0f, Z + {SELU_SCALE}f, y + {SELU_SCALE * SELU_ALPHA}f); }};
auto sigmoid = [&](V x) {{ return 1.0f / (1.0f + exponential(smaller(Z + 80.0f, -x))); }};
"""
    + TAP
)
"""What every snippet of this file needs first: vectors, activations, and taps of the grids."""


class NetworkCode:
    """Generator of C++ for a patch of ``rows`` rows, a multiple of 8.

    Names of the C++ start with ``name``. It reads ``<name>_net``, ``<name>_grid`` and ``<name>_table``, and adds to
    ``<name>_net_gradient`` and ``<name>_grid_gradient``; outputs are in ``<name>_Y``, [rows][padded outputs], and
    :meth:`backward` expects the gradient before the sigmoid in ``<name>_D``, alike, zero where padded.
    """

    def __init__(self, layout: Layout, name: str, rows: int):
        self.layout, self.name, self.count = layout, name, rows

    def scratch(self, backward: bool = True) -> int:
        """Float32 words that :meth:`declare` takes."""
        widths = self.layout.rows
        forward = self.count * sum(widths)
        if not backward:
            return forward
        return forward + self.count * (2 * max(widths) + widths[-1]) + sum(self._matrices())

    def _matrices(self):
        return [a * b for a, b in zip(self.layout.rows[:-1], self.layout.rows[1:], strict=True)]

    def declare(self, backward: bool = True) -> str:
        """C++ of the buffers, taken from ``float* at``; with ``backward`` also the transposed matrices."""
        name, widths, depth = self.name, self.layout.rows, len(self.layout.rows) - 1
        text = []
        for n, width in enumerate(widths):
            text.append(f"float* const {name}_A{n} = at; at += {self.count * width};")
        text.append(f"float* const {name}_Y = {name}_A{depth};")
        if not backward:
            return "\n".join(text)
        text.append(f"float* const {name}_D = at; at += {self.count * widths[-1]};")
        for n in range(2):
            text.append(f"float* const {name}_D{n} = at; at += {self.count * max(widths)};")
        for n, size in enumerate(self._matrices()):
            text.append(f"float* const {name}_T{n} = at; at += {size};")
            text.append(
                f"for (int i = 0; i < {widths[n]}; ++i) for (int o = 0; o < {widths[n + 1]}; ++o) {name}_T{n}"
                f"[o * {widths[n]} + i] = {name}_net[{self.layout.offsets[n][1]} + i * {widths[n + 1]} + o];"
            )
        return "\n".join(text)

    # Visits: loops around a body that is run for every row l and level k. It finds the words of the four vertices
    # in p00, p10, p01, p11 (columns first) and the shares fx, fy of the second column and row.

    def _levels(self, body: str) -> str:
        return (
            f"for (int k = 0; k < {self.layout.levels}; ++k) {{ const int* const level = {self.name}_table + 3 * k;"
            f"const int width = level[0], height = level[1], begin = level[2]; {body} }}"
        )

    def _words(self) -> str:
        corners = ((x, y) for y in range(2) for x in range(2))
        return "".join(
            f"const int p{x}{y} = begin + (j{y} * width + i{x}) * {self.layout.features};" for x, y in corners
        )

    def blocks(self, body: str) -> str:
        """C++ that visits block ``numbers[l]`` of ``block_rows`` × ``block_columns``, one row a block."""
        at_level = f"""int i0, i1, j0, j1; float fx, fy;
            tap((bx + 0.5) / block_columns, width, i0, i1, fx); tap((by + 0.5) / block_rows, height, j0, j1, fy);
            {self._words()} {body}"""
        return f"""for (int l = 0; l < {self.count}; ++l) {{
            const int by = numbers[l] / block_columns, bx = numbers[l] - by * block_columns;
            {self._levels(at_level)} }}"""

    def texels(self, body: str) -> str:
        """C++ that visits the 16 texels of each of those blocks, row 16·block + 4y + x."""
        return self._blocks_of_texels(
            f"""for (int y = 0; y < 4; ++y) for (int x = 0; x < 4; ++x) {{
                const int l = 16 * b + 4 * y + x, i0 = I0[x], i1 = I1[x], j0 = J0[y], j1 = J1[y];
                const float fx = FX[x], fy = FY[y];
                {self._words()} {body}
            }}"""
        )

    def _blocks_of_texels(self, body: str) -> str:
        at_level = f"""int I0[4], I1[4], J0[4], J1[4]; float FX[4], FY[4];
            for (int s = 0; s < 4; ++s) {{
                tap((4 * bx + s + 0.5) * over_x, width, I0[s], I1[s], FX[s]);
                tap((4 * by + s + 0.5) * over_y, height, J0[s], J1[s], FY[s]);
            }}
            {body}"""
        return f"""for (int b = 0; b < {self.count // 16}; ++b) {{
            const int by = numbers[b] / block_columns, bx = numbers[b] - by * block_columns;
            const double over_x = 0.25 / block_columns, over_y = 0.25 / block_rows;
            {self._levels(at_level)} }}"""

    def positions(self, body: str) -> str:
        """C++ that visits (u, v) of ``places[2l]``, for the first ``filled`` rows."""
        at_level = f"""int i0, i1, j0, j1; float fx, fy;
            tap(u - __builtin_floor(u), width, i0, i1, fx); tap(v - __builtin_floor(v), height, j0, j1, fy);
            {self._words()} {body}"""
        return f"""for (int l = 0; l < filled; ++l) {{
            const double u = places[2 * l], v = places[2 * l + 1];
            {self._levels(at_level)} }}"""

    def gather(self, visit) -> str:
        """C++ that looks the inputs of all rows up; ``visit`` is one of the methods above."""
        name, stride, inputs, features = self.name, self.layout.rows[0], self.layout.inputs, self.layout.features
        if visit == self.texels:
            # Where a level is coarse, a row of texels lies between the same two rows of vertices as the one before.
            looked_up = self._blocks_of_texels(
                f"""F upper[4], lower[4];
                auto across = [&](int j, F* found) {{ for (int x = 0; x < 4; ++x) {{
                    const F g0 = *(const F*)({name}_grid + begin + (j * width + I0[x]) * {features});
                    const F g1 = *(const F*)({name}_grid + begin + (j * width + I1[x]) * {features});
                    found[x] = g0 + (g1 - g0) * FX[x]; }} }};
                for (int y = 0; y < 4; ++y) {{
                    if (!y || J0[y] != J0[y - 1]) across(J0[y], upper);
                    if (!y || J1[y] != J1[y - 1]) across(J1[y], lower);
                    for (int x = 0; x < 4; ++x)
                        *(F*)({name}_A0 + (16 * b + 4 * y + x) * {stride} + k * {features})
                            = upper[x] + (lower[x] - upper[x]) * FY[y];
                }}"""
            )
        else:
            looked_up = visit(f"""
            const F g00 = *(const F*)({name}_grid + p00), g10 = *(const F*)({name}_grid + p10);
            const F g01 = *(const F*)({name}_grid + p01), g11 = *(const F*)({name}_grid + p11);
            const F top = g00 + (g10 - g00) * fx, bottom = g01 + (g11 - g01) * fx;
            *(F*)({name}_A0 + l * {stride} + k * {features}) = top + (bottom - top) * fy;""")
        rest = ""
        if inputs < stride:
            rest = (
                f"for (int l = 0; l < {self.count}; ++l) for (int j = {inputs}; j < {stride}; ++j)"
                f" {name}_A0[l * {stride} + j] = 0.0f;"
            )
        return f"{{ {self._row_type()} {looked_up} {rest} }}"

    def scatter(self, visit) -> str:
        """C++ that adds the gradient of the inputs, in ``<name>_D0``, to the grids' gradient."""
        name, stride, features = self.name, self.layout.rows[0], self.layout.features
        body = f"""
            const F d = *(const F*)({name}_D0 + l * {stride} + k * {features});
            const F second = d * fy, first = d - second;
            *(F*)({name}_grid_gradient + p00) += first - first * fx;
            *(F*)({name}_grid_gradient + p10) += first * fx;
            *(F*)({name}_grid_gradient + p01) += second - second * fx;
            *(F*)({name}_grid_gradient + p11) += second * fx;"""
        return f"{{ {self._row_type()} {visit(body)} }}"

    def _row_type(self) -> str:
        return f"typedef float F __attribute__((vector_size({4 * self.layout.features}), aligned(4), may_alias));"

    def forward(self, folded: bool = False) -> str:
        """C++ of all layers; ``folded`` if ``<name>_net`` is: faster, selu within 7e-6, no backward."""
        name, rows, text = self.name, self.layout.rows, []
        for n, (bias, weights) in enumerate(self.layout.offsets):
            last = n == len(rows) - 2
            text.append(
                product(
                    a=f"{name}_A{n}", row=rows[n], step=1, rows=self.count, depth=self.layout.widths[n],
                    b=f"({name}_net + {weights})", stride=rows[n + 1], columns=rows[n + 1], out=f"{name}_A{n + 1}",
                    width=rows[n + 1], start=f"({name}_net + {bias})",
                    apply="sigmoid" if last else "folded_selu" if folded else "selu",
                    few=self.layout.outputs % 8 if last else 0,
                )
            )  # fmt: skip
        return "\n".join(text)

    def backward(self) -> str:
        """C++ from ``<name>_D`` to the gradients of ``net`` and of the inputs, which end up in ``<name>_D0``."""
        name, rows, text = self.name, self.layout.rows, []
        source = f"{name}_D"
        for n in reversed(range(len(rows) - 1)):
            (bias, weights), columns = self.layout.offsets[n], rows[n + 1]
            text.append(f"for (int o = 0; o < {columns}; o += 8) {{ V s = Z; for (int l = 0; l < {self.count}; ++l)"
                        f" s += *(const V*)({source} + l * {columns} + o);"
                        f" *(V*)({name}_net_gradient + {bias} + o) += s; }}")  # fmt: skip
            text.append(
                product(
                    a=f"{name}_A{n}", row=1, step=rows[n], rows=rows[n], depth=self.count, b=source, stride=columns,
                    columns=columns, out=f"({name}_net_gradient + {weights})", width=columns, add=True,
                )
            )  # fmt: skip
            target = f"{name}_D{n % 2}"
            text.append(
                product(
                    a=source, row=columns, step=1, rows=self.count, depth=self.layout.widths[n + 1], b=f"{name}_T{n}",
                    stride=rows[n], columns=rows[n], out=target, width=rows[n],
                    slope=f"{name}_A{n}" if n else None, slope_of="selu_slope",
                )
            )  # fmt: skip
            source = target
        return "\n".join(text)
