"""Fixed-size multilayer perceptrons, evaluated for a block of lanes at a time.

A network is a :class:`MLPShape`, known when the kernel is compiled: dense layers with biases, ReLU between them, a
linear output. Weights are stored as float16 in assets; :func:`pack` widens them once to float32, because a conversion
per use costs half the speed on a CPU.

Layouts, for ``L`` lanes (256 on the CPU, 1 on CUDA):

- inputs and outputs of a block: ``[feature][L]`` float32;
- packed weights: for each layer the biases ``[out]``, then the transposed weights ``[in][out]``.

The CPU code is a register-blocked microkernel: a tile of lanes by a few outputs stays in registers while the inputs
stream by, so that each loaded value feeds several fused multiply-adds. It is generated per shape, since neither Warp's
own matrix types nor the loop vectoriser find that blocking. On CUDA one thread runs the same layers in local memory.

Each shape is a Warp module of its own: in a shared one, every new shape would compile all the others again.
"""

import dataclasses
import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch


@dataclasses.dataclass(frozen=True)
class MLPShape:
    """Sizes of a network: ``MLPShape(12, 16, 9)`` maps 12 inputs over 16 hidden units to 9 outputs."""

    widths: tuple[int, ...]

    def __init__(self, *widths: int):
        if len(widths) < 2 or any(not isinstance(w, int) or not 1 <= w <= 512 for w in widths):
            raise ValueError(f"an MLPShape needs at least two widths between 1 and 512, got {widths}")
        object.__setattr__(self, "widths", widths)

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.widths[0]

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return self.widths[-1]

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """(in, out) of each layer."""
        return tuple(zip(self.widths[:-1], self.widths[1:], strict=True))

    @property
    def parameters(self) -> int:
        """Number of weights and biases."""
        return sum(i * o + o for i, o in self.layers)

    @property
    def flops(self) -> int:
        """Floating-point operations of one evaluation: 2 per weight; biases and ReLU are not counted."""
        return sum(2 * i * o for i, o in self.layers)


def pack(weights, biases) -> np.ndarray:
    """Return the packed float32 weights of a network.

    Args:
        weights: One matrix per layer, shape [out, in] (torch's order), any float type.
        biases: One vector per layer, shape [out].

    Raises:
        ValueError: If a shape does not continue the layer before it.
    """
    parts, width = [], np.asarray(weights[0]).shape[-1]
    for layer, (w, b) in enumerate(zip(weights, biases, strict=True)):
        w, b = np.asarray(w, np.float32), np.asarray(b, np.float32)
        if w.ndim != 2 or w.shape[1] != width or b.shape != (w.shape[0],):
            raise ValueError(
                f"weights[{layer}] must have shape [out, {width}] and biases[{layer}] [out], "
                f"got {w.shape} and {b.shape}"
            )
        parts += [b, w.T.ravel()]
        width = w.shape[0]
    return np.concatenate(parts)


def split_outputs(outputs: int, most: int) -> list[tuple[int, int, int]]:
    """Return runs (start, size, count) of blocks of at most ``most`` that together are ``outputs``.

    Blocks are as even as possible: one of one or two outputs has too few independent sums to hide the latency of a
    fused multiply-add.
    """
    count = -(-outputs // most)
    small, extra = divmod(outputs, count)
    runs = []
    if extra:
        runs.append((0, small + 1, extra))
    if count > extra:
        runs.append((extra * (small + 1), small, count - extra))
    return runs


def layer_code(inputs, outputs, *, source, stride, target, target_stride, offset, relu, most, vectors) -> str:
    """C++ for one layer over one tile of ``vectors`` vectors of lanes."""
    text = []
    bias, weight = offset, offset + outputs
    for start, size, count in split_outputs(outputs, most):
        cells = [(b, u) for b in range(size) for u in range(vectors)]
        text.append(f"for (int r = 0; r < {count}; ++r) {{ const int o = {start} + r * {size};")
        text += [f"V a{b}_{u} = {{}}; a{b}_{u} += w[{bias} + o + {b}];" for b, u in cells]
        text.append(f"const float* wk = w + {weight} + o; const float* xk = {source};")
        # Four steps at a time: measured 0.74 -> 0.81 of peak for 12-16-9, no difference for wide layers (Zen 3).
        text.append('_Pragma("clang loop unroll_count(4)")')
        text.append(f"for (int k = 0; k < {inputs}; ++k, wk += {outputs}, xk += {stride}) {{")
        text += [f"const V x{u} = *(const V*)(xk + {u} * NV);" for u in range(vectors)]
        for b in range(size):
            text.append(
                f"{{ const float s = wk[{b}];" + "".join(f" a{b}_{u} += x{u} * s;" for u in range(vectors)) + " }"
            )
        text.append("}")
        for b, u in cells:
            value = f"(a{b}_{u} > 0.0f ? a{b}_{u} : Z)" if relu else f"a{b}_{u}"
            text.append(f"*(V*)({target} + (o + {b}) * {target_stride} + {u} * NV) = {value};")
        text.append("}")
    return "\n".join(text)


def _cpu_code(shape: MLPShape, lanes: int, *, vector: int, vectors: int, most: int) -> str:
    """C++ of the whole network over ``lanes`` lanes: ``vector`` floats a register, ``vectors`` × ``most`` sums."""
    tile = vector * vectors
    widest = max(shape.widths[1:-1], default=1)
    text = [
        f"typedef float V __attribute__((vector_size({4 * vector}), aligned(4), may_alias)); enum {{ NV = {vector} }};",
        "const V Z = {};",
        f"alignas(64) float h0[{widest * tile}]; alignas(64) float h1[{widest * tile}];",
        # Inputs lie a whole lane block apart: more of them than a cache set holds would evict each other.
        f"alignas(64) float hx[{shape.inputs * tile}];" if shape.inputs > 24 else "",
        "const float* w = weights.data;",
        f"for (int t = 0; t < {lanes}; t += {tile}) {{",
    ]
    source, stride = "(x.data + t)", lanes
    if shape.inputs > 24:
        copies = " ".join(
            f"*(V*)(hx + k * {tile} + {u} * NV) = *(const V*)(x.data + k * {lanes} + t + {u} * NV);"
            for u in range(vectors)
        )
        text.append(f"for (int k = 0; k < {shape.inputs}; ++k) {{ {copies} }}")
        source, stride = "hx", tile
    offset = 0
    for layer, (inputs, outputs) in enumerate(shape.layers):
        last = layer == len(shape.layers) - 1
        target, target_stride = ("(y.data + t)", lanes) if last else (f"h{layer % 2}", tile)
        text.append(
            layer_code(
                inputs, outputs, source=source, stride=stride, target=target, target_stride=target_stride,
                offset=offset, relu=not last, most=most, vectors=vectors,
            )
        )  # fmt: skip
        source, stride = target, tile
        offset += inputs * outputs + outputs
    text.append("}")
    return "\n".join(text)


def _scalar_code(shape: MLPShape) -> str:
    """C++/CUDA of the network for one lane."""
    widest = max(shape.widths[1:-1], default=1)
    text = [f"float h0[{widest}]; float h1[{widest}]; const float* w = weights.data;"]
    source, offset = "x.data", 0
    for layer, (inputs, outputs) in enumerate(shape.layers):
        last = layer == len(shape.layers) - 1
        target = "y.data" if last else f"h{layer % 2}"
        value = "a" if last else "(a > 0.0f ? a : 0.0f)"
        text.append(
            f"for (int o = 0; o < {outputs}; ++o) {{ float a = w[{offset} + o];"
            f" for (int k = 0; k < {inputs}; ++k) a += w[{offset + outputs} + k * {outputs} + o] * {source}[k];"
            f" {target}[o] = {value}; }}"
        )
        source = target
        offset += inputs * outputs + outputs
    return "\n".join(text)


@functools.cache
def make_mlp(shape: MLPShape, lanes: int):
    """Return a Warp function ``mlp(x, weights, y)`` that evaluates ``shape`` for one block of ``lanes`` lanes.

    For use inside lane kernels: ``x`` is a float32 array of [inputs][lanes], ``weights`` is packed (:func:`pack`), and
    ``y`` receives [outputs][lanes]. ``x`` and ``y`` must not overlap.

    Error: at most 4e-6 of the output's scale against float64; held by test_mlp_matches_float64.
    """
    if lanes == 1:
        snippet = _scalar_code(shape)
    else:
        wide = _cpu_code(shape, lanes, vector=16, vectors=2, most=8)
        middle = _cpu_code(shape, lanes, vector=8, vectors=2, most=6)
        narrow = _cpu_code(shape, lanes, vector=4, vectors=4, most=4)
        snippet = f"#if defined(__AVX512F__)\n{wide}\n#elif defined(__AVX__)\n{middle}\n#else\n{narrow}\n#endif\n"

    @wp.func_native(snippet)
    def mlp(x: wp.array(dtype=wp.float32), weights: wp.array(dtype=wp.float32), y: wp.array(dtype=wp.float32)): ...

    return mlp


@functools.cache
def make_rows_kernel(shape: MLPShape, lanes: int):
    """Return a kernel that evaluates ``shape`` for the rows of a matrix, shapes [n, inputs] → [n, outputs]."""
    mlp = make_mlp(shape, lanes)
    I, O, L = shape.inputs, shape.outputs, lanes  # noqa: E741
    ROW_IN, ROW_OUT = I, O  # a constant that is cast keeps the new type in the rest of the kernel
    FLOAT = wp.constant(wp.uint64(4))

    if lanes == 1:  # one row is already a block of one lane

        @wp.kernel(module="unique", module_options=dispatch.module_options())
        def mlp_rows_kernel(
            first: int,
            slot: int,
            rows: wp.array(dtype=wp.float32),
            count: int,
            weights: wp.array(dtype=wp.float32),
            scratch: wp.array(dtype=wp.float32),
            # outputs
            result: wp.array(dtype=wp.float32),
        ):
            b = first + wp.tid()
            X = wp.array(ptr=rows.ptr + wp.uint64(b) * wp.uint64(ROW_IN) * FLOAT, shape=(I,), dtype=wp.float32)
            Y = wp.array(ptr=result.ptr + wp.uint64(b) * wp.uint64(ROW_OUT) * FLOAT, shape=(O,), dtype=wp.float32)
            mlp(X, weights, Y)

        return mlp_rows_kernel

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def mlp_rows_kernel(
        first: int,
        slot: int,
        rows: wp.array(dtype=wp.float32),
        count: int,
        weights: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        result: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64((I + O) * L) * FLOAT
        X = wp.array(ptr=own, shape=(I * L,), dtype=wp.float32)
        Y = wp.array(ptr=own + wp.uint64(I * L) * FLOAT, shape=(O * L,), dtype=wp.float32)
        R = wp.array(ptr=rows.ptr + wp.uint64(b) * wp.uint64(I * L) * FLOAT, shape=(I * L,), dtype=wp.float32)
        W = wp.array(ptr=result.ptr + wp.uint64(b) * wp.uint64(O * L) * FLOAT, shape=(O * L,), dtype=wp.float32)
        if (b + 1) * L <= count:
            for k in range(I):
                for l in range(L):
                    X[k * L + l] = R[l * I + k]
            mlp(X, weights, Y)
            for k in range(O):
                for l in range(L):
                    W[l * O + k] = Y[k * L + l]
        else:
            rest = count - b * L
            for k in range(I):
                for l in range(L):
                    X[k * L + l] = 0.0
                    if l < rest:
                        X[k * L + l] = R[l * I + k]
            mlp(X, weights, Y)
            for k in range(O):
                for l in range(L):
                    if l < rest:
                        W[l * O + k] = Y[k * L + l]

    return mlp_rows_kernel


def mlp_eval(shape: MLPShape, x, packed, *, out=None):
    """Evaluate a network for the rows of ``x``, spread over all cores.

    Args:
        shape: Sizes of the network.
        x: Inputs, shape [n, inputs], float32; numpy, torch or Warp.
        packed: Packed weights (:func:`pack`), shape [parameters], float32, same device.
        out: Warp array, shape [n, outputs], written in place when given.

    Returns: Outputs, shape [n, outputs], float32, of the kind of ``x``.
    Raises: ValueError: If a shape or device differs.
    Error: at most 4e-6 of the output's scale against float64; held by test_mlp_matches_float64.
    """
    kind = arrays.kind_of(x)
    rows = arrays.take(x, "x", ("n", shape.inputs), wp.float32, kind)
    weights = arrays.take(packed, "packed", (shape.parameters,), wp.float32, kind)
    count = rows.shape[0]
    result = kind.empty((count, shape.outputs), wp.float32) if out is None else out
    if result.shape != (count, shape.outputs) or result.dtype != wp.float32 or result.device != kind.device:
        raise ValueError(
            f"out must be float32 of shape [{count}, {shape.outputs}] on {kind.device}, got {result.shape}"
        )
    if count == 0:  # Warp does not flatten an empty array
        return result if out is not None else kind.give(result)
    lanes = dispatch.lanes(kind.device)
    size = dispatch.worker_count() * (shape.inputs + shape.outputs) * lanes if lanes > 1 else 1
    scratch = wp.empty(size, dtype=wp.float32, device=kind.device)
    dispatch.launch(
        make_rows_kernel(shape, lanes),
        dispatch.blocks(count, lanes),
        inputs=[rows.flatten(), count, weights, scratch],
        outputs=[result.flatten()],
        device=kind.device,
    )
    return result if out is not None else kind.give(result)
