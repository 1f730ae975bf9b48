"""NeuBRDF evaluation (paper [neubrdf], Eq. 1–3): spherical index grids, a codebook, and a small network.

A direction selects the four corners of its HEALPix pixel; each corner's index selects a codeword; the weighted sum is
the direction's feature. The features of ω_i and ω_o together enter the network. Here the first layer is *folded into
the codebook*: with ψ = Σ w_t D[S[p_t]], the product W₁ψ equals Σ w_t (W₁D)[S[p_t]], so rows of W₁D, one table for
each direction, are summed instead, and a quarter of the network's multiplications disappear. What depends on ω_o is
computed once for all lights.

Evaluation is written for a block of ``L`` lanes and in two calls: :attr:`Functions.view` once, :attr:`Functions.light`
for each light, over a list of active lanes only; lanes without work cost nothing. Rows (one lane's hidden units) lie
contiguous, so a gathered codebook row feeds vector instructions as it is.

Scratch of a block, float32 words (int32 where said): position and weight of the four corners [8][L], rotation [2][L],
first-layer sums of ω_o [L][H₁].
"""

import dataclasses
import functools
import types

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.approx import exp2
from warp_neumat.kernels.frame import safe_normalize
from warp_neumat.kernels.healpix import corners_of

PAD = 16
"""Hidden widths are padded with zeros to a multiple of this, the widest float32 register."""

_MODULE = {"module": "unique", "module_options": dispatch.module_options()}


def padded(width: int) -> int:
    """Return ``width`` rounded up to a multiple of :data:`PAD`."""
    return -(-width // PAD) * PAD


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a kernel is compiled for: hidden widths, and whether the frame is rotated to the viewer's azimuth."""

    hidden: tuple[int, ...] = (64, 64)
    isotropic: bool = False

    @property
    def rows(self) -> tuple[int, ...]:
        """Padded hidden widths."""
        return tuple(padded(h) for h in self.hidden)

    def scratch(self, lanes: int) -> int:
        """Return the float32 words of scratch for one block of ``lanes`` lanes."""
        return lanes * (8 + 2 + self.rows[0])

    @property
    def flops(self) -> int:
        """Operations of one evaluation at one light as executed: folded gathers, hidden and output layers."""
        middle = sum(i * o for i, o in zip(self.rows[:-1], self.rows[1:], strict=True))
        return 2 * (4 * self.rows[0] + middle + 3 * self.rows[-1])


@wp.struct
class Grid:
    """Device arrays of one material; see :func:`fold` for their contents."""

    nside: int
    index_i: wp.array(dtype=wp.uint16)
    index_o: wp.array(dtype=wp.uint16)
    table_i: wp.array(dtype=wp.float32)
    table_o: wp.array(dtype=wp.float32)
    weights: wp.array(dtype=wp.float32)


def fold(codebook, weights, biases) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fold a network's first layer into its codebook and pack the rest for the kernels.

    Args:
        codebook: Codewords, shape [codes, k].
        weights: Weight matrices [out, in] of all layers; the first has 2k inputs, ω_i's feature before ω_o's.
        biases: Bias vectors of all layers.

    Returns: table_i [codes, H₁]; table_o [codes, H₁] including the first bias (corner weights sum to one); and the
        packed further layers: per hidden layer biases [H], transposed weights [H_in, H]; then the output's biases [3]
        and weights [3, H]. All float32, hidden widths padded with zeros; the folding itself is done in float64.
    """
    d, k = np.asarray(codebook, np.float64), codebook.shape[1]
    first, hidden = np.asarray(weights[0], np.float64), padded(weights[0].shape[0])

    def table(part, bias):
        rows = np.zeros((len(d), hidden), np.float32)
        rows[:, : len(first)] = d @ part.T + bias
        return rows

    packed, width = [], hidden
    for w, b in zip(weights[1:-1], biases[1:-1], strict=True):
        out = padded(w.shape[0])
        bias, matrix = np.zeros(out, np.float32), np.zeros((width, out), np.float32)
        bias[: len(b)] = b
        matrix[: w.shape[1], : w.shape[0]] = np.asarray(w, np.float32).T
        packed += [bias, matrix.ravel()]
        width = out
    last = np.zeros((3, width), np.float32)
    last[:, : weights[-1].shape[1]] = weights[-1]
    packed += [np.asarray(biases[-1], np.float32), last.ravel()]
    return table(first[:, :k], 0.0), table(first[:, k:], np.asarray(biases[0], np.float64)), np.concatenate(packed)


def _vector_code(layout: Layout, lanes: int, *, vector: int, rows: int, vectors: int) -> str:
    """C++ of the network for the active lanes, ``rows`` at a time, outputs in ``vectors`` registers of ``vector``."""
    first, nv = layout.rows[0], vector
    text = [
        f"typedef float V __attribute__((vector_size({4 * nv}), aligned(4), may_alias)); enum {{ NV = {nv} }};",
        "const V Z = {};",
        f"alignas(64) float h0[{rows * max(layout.rows)}]; alignas(64) float h1[{rows * max(layout.rows)}];",
        f"for (int a = 0; a < count; a += {rows}) {{ int lane[{rows}];",
        # The last group repeats its last lane: the same values are written twice.
        f"for (int r = 0; r < {rows}; ++r) {{",
        "const int l = active.data[a + r < count ? a + r : count - 1]; lane[r] = l;",
        "const float* t[4]; float c[4];",
        "for (int q = 0; q < 4; ++q) {",
        f"t[q] = table.data + {first} * (long long)index.data[place.data[q * {lanes} + l]];",
        f"c[q] = corner.data[q * {lanes} + l]; }}",
        f"const float* base = view.data + l * {first};",
        f"for (int j = 0; j < {first}; j += NV) {{ V v = *(const V*)(base + j);"
        " for (int q = 0; q < 4; ++q) v += *(const V*)(t[q] + j) * c[q];"
        f" *(V*)(h0 + r * {first} + j) = v > 0.0f ? v : Z; }} }}",
    ]
    source, offset, width = 0, 0, first
    for out in layout.rows[1:]:
        step = nv * vectors
        text.append(f"for (int o = 0; o < {out}; o += {step}) {{ const float* w = weights.data + {offset + out} + o;")
        cells = [(r, u) for r in range(rows) for u in range(vectors)]
        text += [f"V a{r}_{u} = *(const V*)(weights.data + {offset} + o + {u} * NV);" for r, u in cells]
        text.append('_Pragma("clang loop unroll_count(4)")')
        text.append(f"for (int k = 0; k < {width}; ++k, w += {out}) {{")
        text += [f"const V w{u} = *(const V*)(w + {u} * NV);" for u in range(vectors)]
        for r in range(rows):
            adds = "".join(f" a{r}_{u} += w{u} * s;" for u in range(vectors))
            text.append(f"{{ const float s = h{source}[{r * width} + k];{adds} }}")
        text.append("}")
        text += [f"*(V*)(h{1 - source} + {r * out} + o + {u} * NV) = a{r}_{u} > 0.0f ? a{r}_{u} : Z;" for r, u in cells]
        text.append("}")
        offset += out + width * out
        source, width = 1 - source, out
    text.append(f"const float* wl = weights.data + {offset + 3};")
    text.append(
        f"for (int r = 0; r < {rows}; ++r) {{ V s0 = Z, s1 = Z, s2 = Z; const float* h = h{source} + r * {width};"
    )
    text.append(f"for (int j = 0; j < {width}; j += NV) {{ const V v = *(const V*)(h + j);")
    text += [f"s{c} += v * *(const V*)(wl + {c * width} + j);" for c in range(3)]
    text.append("}")
    text.append(
        "float f0 = 0.0f, f1 = 0.0f, f2 = 0.0f; for (int u = 0; u < NV; ++u) { f0 += s0[u]; f1 += s1[u]; f2 += s2[u]; }"
    )
    text += [f"y.data[{c * lanes} + lane[r]] = f{c} + weights.data[{offset + c}];" for c in range(3)]
    text.append("} }")
    return "\n".join(text)


def _scalar_code(layout: Layout) -> str:
    """C++/CUDA of the network for the one lane of a block."""
    first, widest = layout.rows[0], max(layout.rows)
    text = [
        f"float h0[{widest}]; float h1[{widest}];",
        f"for (int j = 0; j < {first}; ++j) {{ float v = view.data[j];"
        " for (int q = 0; q < 4; ++q)"
        f" v += table.data[{first} * (long long)index.data[place.data[q]] + j] * corner.data[q];"
        " h0[j] = v > 0.0f ? v : 0.0f; }",
    ]
    source, offset, width = 0, 0, first
    for out in layout.rows[1:]:
        text.append(
            f"for (int o = 0; o < {out}; ++o) {{ float v = weights.data[{offset} + o];"
            f" for (int k = 0; k < {width}; ++k) v += weights.data[{offset + out} + k * {out} + o] * h{source}[k];"
            f" h{1 - source}[o] = v > 0.0f ? v : 0.0f; }}"
        )
        offset += out + width * out
        source, width = 1 - source, out
    text.append(
        f"for (int c = 0; c < 3; ++c) {{ float v = weights.data[{offset} + c];"
        f" for (int k = 0; k < {width}; ++k) v += weights.data[{offset + 3} + c * {width} + k] * h{source}[k];"
        " y.data[c] = v; }"
    )
    return "\n".join(text)


@functools.cache
def functions(layout: Layout, lanes: int) -> types.SimpleNamespace:
    """Return the Warp functions that evaluate a material of ``layout`` for a block of ``lanes`` lanes.

    - ``view(grid, wo, active, count, scratch)``: takes the local ω_o, [3][L];
    - ``light(grid, wi, active, count, scratch, value)``: takes the local ω_i, [3][L], and writes the BRDF [1/sr]
      without the cosine, [3][L].

    Either works for the first ``count`` lanes listed in ``active``; a light's must be among the view's.

    Directions must be unit with z ≥ 0: the caller lists only lanes above the horizon.
    """
    L, H1, isotropic = lanes, layout.rows[0], layout.isotropic
    FLOAT = wp.constant(wp.uint64(4))

    view_rows = f"""
        for (int a = 0; a < count; ++a) {{
            const int l = active.data[a]; const float* t[4]; float c[4];
            for (int q = 0; q < 4; ++q) {{
                t[q] = table.data + {H1} * (long long)index.data[place.data[q * {L} + l]];
                c[q] = corner.data[q * {L} + l];
            }}
            float* out = view.data + l * {H1};
            for (int j = 0; j < {H1}; ++j) out[j] = t[0][j] * c[0] + t[1][j] * c[1] + t[2][j] * c[2] + t[3][j] * c[3];
        }}
    """
    network_code = (
        _scalar_code(layout)
        if lanes == 1
        else f"#if defined(__AVX512F__)\n{_vector_code(layout, lanes, vector=16, rows=8, vectors=1)}\n"
        f"#elif defined(__AVX__)\n{_vector_code(layout, lanes, vector=8, rows=4, vectors=2)}\n"
        f"#else\n{_vector_code(layout, lanes, vector=4, rows=4, vectors=4)}\n#endif\n"
    )

    @wp.func_native(view_rows)
    def view_sums(
        index: wp.array(dtype=wp.uint16),
        table: wp.array(dtype=wp.float32),
        place: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        view: wp.array(dtype=wp.float32),
    ): ...

    @wp.func_native(network_code)
    def network(
        index: wp.array(dtype=wp.uint16),
        table: wp.array(dtype=wp.float32),
        weights: wp.array(dtype=wp.float32),
        place: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.float32),
        view: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        y: wp.array(dtype=wp.float32),
    ): ...

    @wp.func
    def locate(nside: int, at: wp.uint64, scratch: wp.uint64):
        # The arrays are made here, of constant size: through an argument the vectoriser would not see their bounds.
        directions = wp.array(ptr=at, shape=(3 * L,), dtype=wp.float32)
        place = wp.array(ptr=scratch, shape=(4 * L,), dtype=wp.int32)
        corner = wp.array(ptr=scratch + wp.uint64(4 * L) * FLOAT, shape=(4 * L,), dtype=wp.float32)
        rotation = wp.array(ptr=scratch + wp.uint64(8 * L) * FLOAT, shape=(2 * L,), dtype=wp.float32)
        for l in range(L):
            d = wp.vec3(directions[l], directions[L + l], wp.max(directions[2 * L + l], 0.0))
            if wp.static(isotropic):
                c = rotation[l]
                s = rotation[L + l]
                d = wp.vec3(c * d[0] + s * d[1], wp.abs(c * d[1] - s * d[0]), d[2])
            p, w = corners_of(nside, d)
            place[l] = p[0]
            place[L + l] = p[1]
            place[2 * L + l] = p[2]
            place[3 * L + l] = p[3]
            corner[l] = w[0]
            corner[L + l] = w[1]
            corner[2 * L + l] = w[2]
            corner[3 * L + l] = w[3]

    @wp.func
    def view(
        grid: Grid,
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
    ):
        place = wp.array(ptr=scratch, shape=(4 * L,), dtype=wp.int32)
        corner = wp.array(ptr=scratch + wp.uint64(4 * L) * FLOAT, shape=(4 * L,), dtype=wp.float32)
        rotation = wp.array(ptr=scratch + wp.uint64(8 * L) * FLOAT, shape=(2 * L,), dtype=wp.float32)
        sums = wp.array(ptr=scratch + wp.uint64(10 * L) * FLOAT, shape=(L * H1,), dtype=wp.float32)
        if wp.static(isotropic):
            direction = wp.array(ptr=wo.ptr, shape=(3 * L,), dtype=wp.float32)
            for l in range(L):
                x = direction[l]
                y = direction[L + l]
                s2 = x * x + y * y
                off_axis = s2 >= 1.0e-12
                scale = 1.0 / wp.sqrt(wp.max(s2, 1.0e-12))
                rotation[l] = wp.where(off_axis, x * scale, 1.0)
                rotation[L + l] = wp.where(off_axis, y * scale, 0.0)
        locate(grid.nside, wo.ptr, scratch)
        view_sums(grid.index_o, grid.table_o, place, corner, active, count, sums)

    @wp.func
    def light(
        grid: Grid,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        place = wp.array(ptr=scratch, shape=(4 * L,), dtype=wp.int32)
        corner = wp.array(ptr=scratch + wp.uint64(4 * L) * FLOAT, shape=(4 * L,), dtype=wp.float32)
        sums = wp.array(ptr=scratch + wp.uint64(10 * L) * FLOAT, shape=(L * H1,), dtype=wp.float32)
        locate(grid.nside, wi.ptr, scratch)
        network(grid.index_i, grid.table_i, grid.weights, place, corner, sums, active, count, value)
        out = wp.array(ptr=value.ptr, shape=(3 * L,), dtype=wp.float32)
        for l in range(3 * L):
            # exp(y) − 1, held below float16's largest number; a BRDF is not negative.
            e = exp2(wp.min(out[l], 11.0) * 1.4426950408889634)
            out[l] = wp.max(e - 1.0, 0.0)

    return types.SimpleNamespace(view=view, light=light, Arguments=Grid)


@functools.cache
def make_eval_kernel(layout: Layout, lanes: int):
    """Return the kernel behind ``Material.eval``: pairs of local directions → BRDF × cosine."""
    evaluate = functions(layout, lanes)
    view, light = evaluate.view, evaluate.light
    L = lanes
    # Two names, because a constant that is cast keeps the new type in the rest of the kernel.
    TOTAL = STRIDE = layout.scratch(lanes) + 10 * lanes
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(**_MODULE)
    def neubrdf_eval_kernel(
        first: int,
        slot: int,
        grid: Grid,
        wi: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        count: int,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        result: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        if wp.static(L == 1):
            local = wp.zeros(shape=TOTAL, dtype=wp.float32)
            own = local.ptr
        I = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        O = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        Y = wp.array(ptr=own + wp.uint64(6 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        active = wp.array(ptr=own + wp.uint64(9 * L) * FLOAT, shape=(L,), dtype=wp.int32)
        own = own + wp.uint64(10 * L) * FLOAT
        lit = int(0)
        rest = wp.min(count - b * L, L)
        for l in range(L):
            at = 3 * (b * L + wp.min(l, rest - 1))
            i = safe_normalize(wp.vec3(wi[at], wi[at + 1], wi[at + 2]))
            o = safe_normalize(wp.vec3(wo[at], wo[at + 1], wo[at + 2]))
            for c in range(3):
                I[c * L + l] = i[c]
                O[c * L + l] = o[c]
                Y[c * L + l] = 0.0
            if l < rest and i[2] > 0.0 and o[2] > 0.0:
                active[lit] = l
                lit += 1
        if lit > 0:
            view(grid, O, active, lit, own)
            light(grid, I, active, lit, own, Y)
        for l in range(L):
            if l < rest:
                cosine = I[2 * L + l]
                above = cosine > 0.0 and O[2 * L + l] > 0.0
                at = 3 * (b * L + l)
                for c in range(3):
                    result[at + c] = wp.where(above, Y[c * L + l] * cosine, 0.0)

    return neubrdf_eval_kernel
