"""Neural BTF evaluation (paper [mobilevr], §4.1, 4.3, 4.4): a coarse network a quad, a fine network a texel.

The coarse network sees ω_i, ω_o, the half vector h and a coarse texture, once for a quad of 2 × 2 texels; its latent
vector and a fine texture enter the fine network, once for each texel. ``view`` does once for all lights what does not
depend on them: both fetches, and of both first layers b + W [ω_o, features]. A light then adds 6 inputs to the first
layer of the coarse network. What its latent vector adds to the fine network's first layer is one vector for the whole
quad, so that for each texel only the layers behind remain.

A *single-level* network (no coarse one) sees the angles and one texture for each texel.

Lanes ↔ quads: lanes 4q … 4q + 3 of a block are a quad, wanted or lit as the caller's lists say. uv, mip level and ω_o
are means over its wanted lanes, ω_i over its lit ones, directions normalised again. Where the texels of a quad lie more
than :data:`~.btf_code.SEAM` texels apart, as over a chart's seam, each lane is evaluated by itself. On CUDA, where
a block is one lane, a shading kernel does not see quads, and every lane is evaluated by itself: correct, but the
coarse network then is not shared. ``BTF.eval_quads`` shares it there too, a quad a thread.

A light costs what its lit lanes cost, in rows of 16 (:mod:`~.btf_code`): rows without a lit lane are skipped.

Features lie as float16, channels of a texel padded to a multiple of 8; sums are float32.
"""

import dataclasses
import functools
import types

import numpy as np
import warp as wp

from warp_neumat.kernels import btf_code, btf_light_code, btf_scalar, btf_view_code, dispatch
from warp_neumat.kernels.frame import safe_normalize
from warp_neumat.kernels.neubrdf_code import by_width

CHANNEL_PAD = 8
"""Channels of a texel are padded with zeros to a multiple of this: 16 bytes, the unit in which textures are counted."""

_MODULE = {"module": "unique", "module_options": dispatch.module_options()}


@dataclasses.dataclass(frozen=True)
class Net:
    """A network's texture and hidden layers."""

    channels: int
    hidden: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a kernel is compiled for."""

    fine: Net = Net(16, (8, 8, 8))
    coarse: Net | None = Net(14, (8, 8, 8))
    latent: int = 8
    """Outputs of the coarse network."""
    half_vector: bool = True
    activation: str = "hardswish"
    """Of the hidden layers and the latents, one of :data:`btf_code.ACTIVATIONS`."""

    @staticmethod
    def padded(channels: int) -> int:
        """Return the channels of a texel as stored."""
        return -(-channels // CHANNEL_PAD) * CHANNEL_PAD

    @property
    def angles(self) -> int:
        """Inputs that the angles are."""
        return 9 if self.half_vector else 6

    @property
    def widths(self) -> dict[str, tuple[int, ...]]:
        """Widths of each network, inputs and outputs included."""
        fine, coarse = self.fine, self.coarse
        if coarse is None:
            return {"fine": (self.angles + fine.channels, *fine.hidden, 3)}
        return {
            "coarse": (self.angles + coarse.channels, *coarse.hidden, self.latent),
            "fine": (self.latent + fine.channels, *fine.hidden, 3),
        }

    @property
    def parameters(self) -> int:
        """Number of weights and biases."""
        return sum(i * o + o for w in self.widths.values() for i, o in zip(w[:-1], w[1:], strict=True))

    @functools.cached_property
    def _places(self) -> dict[str, int]:
        places, at = {}, 0
        for name, widths in self.widths.items():
            channels = (self.coarse if name == "coarse" else self.fine).channels
            entering = 0 if name == "fine" and self.coarse else self.angles
            tail = sum(i * o + o for i, o in zip(widths[1:-1], widths[2:], strict=True))
            if not entering:
                places["latent"] = at
                at += self.latent * widths[1]
            seen = channels + (3 if entering else 0)
            for part, size in (
                ("view", (1 + seen) * widths[1]),
                ("light", max(entering - 3, 0) * widths[1]),
                ("tail", tail),
            ):
                places[f"{name} {part}"] = at
                at += size
        return places

    def at(self, part: str) -> int:
        """Return the word at which a part of the packed weights (:func:`pack`) begins."""
        return self._places[part]

    def parts(self, lanes: int) -> dict[str, tuple[int, str]]:
        """Return (first word, C type) of each part of a block's scratch.

        On the CPU: ``head``, how many groups, rows and wanted lanes; ``row_of`` [G + 1], the first row of each group;
        ``source`` [G][ROW], each item's quad, or L/4 + lane for a lane by itself; ``dense`` [G], 1 where all items of a
        group are whole quads, 2 where they follow each other, or without groups [R], 1 where a row's lanes do;
        ``lane`` [R][ROW]; ``mask`` [L], 1 for wanted lanes; unit ω_o, ``view`` [G][3][ROW] or ``seen`` [R][3][ROW]; and
        sums of the first layers that lights add to, ``coarse`` [G][H][ROW] and ``fine`` [R][H][ROW].
        """
        fine, row = self.fine.hidden[0], btf_code.ROW
        first = self.coarse.hidden[0] if self.coarse else 0
        if lanes < row:
            sizes = {"head": (2, "int"), "seen": (3 * lanes, "float")}
            sizes |= {"coarse": (first * lanes, "float"), "fine": (fine * lanes, "float")}
        elif self.coarse:
            # Items by falling number of lanes fill all rows of a group but in four groups.
            groups, rows = lanes // row + 1, lanes // row + 5
            sizes = {"head": (3, "int"), "row_of": (groups + 1, "int"), "dense": (groups, "int")}
            sizes |= {"source": (groups * row, "int"), "lane": (rows * row, "int"), "mask": (lanes, "float")}
            sizes |= {"view": (3 * groups * row, "float"), "coarse": (first * groups * row, "float")}
            sizes |= {"fine": (fine * rows * row, "float")}
        else:
            rows = lanes // row
            sizes = {"head": (3, "int"), "dense": (rows, "int"), "lane": (rows * row, "int"), "mask": (0, "float")}
            sizes |= {"seen": (3 * rows * row, "float"), "fine": (fine * rows * row, "float")}
        result, at = {}, 0
        for name, (size, kind) in sizes.items():
            result[name] = (at, kind)
            at += -(-size // row) * row if lanes >= row else size
        result["end"] = (at, "float")
        return result

    def scratch(self, lanes: int) -> int:
        """Return the float32 words of scratch for one block of ``lanes`` lanes."""
        return self.parts(lanes)["end"][0]


@wp.struct
class Arguments:
    """Device arrays of one material, and where in them it begins; see :func:`pack` and :func:`pack_textures`."""

    texels: wp.array(dtype=wp.uint16)
    levels: wp.array(dtype=wp.int32)
    weights: wp.array(dtype=wp.float32)
    level_at: int
    weight_at: int


def pack(layout: Layout, weights: dict, biases: dict) -> np.ndarray:
    """Return the packed weights, flat float32.

    Args:
        layout: Their sizes.
        weights, biases: Matrices [out, in] and vectors [out] of all layers of ``"fine"`` and ``"coarse"``.

    Layers are biases [out], then transposed weights [in][out]. First layers are split: what the view knows (biases,
    ω_o, features), what the light brings (ω_i, h), and the fine network's share of the latent vector, without biases.
    """
    parts = []
    for name in layout.widths:
        w = [np.asarray(m, np.float32) for m in weights[name]]
        b = [np.asarray(v, np.float32) for v in biases[name]]
        if name == "fine" and layout.coarse:
            latent = layout.latent
            parts += [w[0][:, :latent].T, b[0], w[0][:, latent:].T]
        else:
            angles = layout.angles
            parts += [b[0], w[0][:, 3:6].T, w[0][:, angles:].T, w[0][:, :3].T, w[0][:, 6:angles].T]
        for matrix, bias in zip(w[1:], b[1:], strict=True):
            parts += [bias, matrix.T]
    return np.concatenate([p.ravel() for p in parts])


def pack_textures(fine, coarse=None) -> tuple[np.ndarray, np.ndarray]:
    """Return (levels, texels) of a material.

    Args:
        fine, coarse: Mips from the finest on, each (h, w, c) float16.

    Returns: ``levels``: the number of mips, then for each width, height and place of the fine texture and of the coarse
        one, flat int32; ``texels``: bits of the float16 values, row by row, channels padded with zeros, flat uint16.
        A place counts 16 bytes.

    Raises: ValueError: If there are more values than 31 bits can number.
    """
    size = sum(m.shape[0] * m.shape[1] * Layout.padded(m.shape[2]) for m in (*fine, *(coarse or ())))
    if size >= 1 << 31:
        raise ValueError(f"textures must have fewer than 2^31 values, got {size}")
    levels, texels, first = [len(fine)], [], 0
    for pair in zip(fine, coarse or [None] * len(fine), strict=True):
        for mip in pair:
            if mip is None:
                levels += [1, 1, 0]
                continue
            height, width, channels = mip.shape
            levels += [width, height, first]
            wide = np.zeros((height, width, Layout.padded(channels)), np.float16)
            wide[..., :channels] = mip
            texels.append(wide.ravel())
            first += wide.size // 8
    return np.array(levels, np.int32), np.concatenate(texels).view(np.uint16)


def device_arrays(layout: Layout, weights: dict, biases: dict, fine, coarse, device) -> Arguments:
    """Return the :class:`Arguments` of a material; arguments as of :func:`pack` and :func:`pack_textures`."""
    levels, texels = pack_textures(fine, coarse)
    result = Arguments()
    result.texels = wp.array(texels, dtype=wp.uint16, device=device)
    result.levels = wp.array(levels, dtype=wp.int32, device=device)
    result.weights = wp.array(pack(layout, weights, biases), dtype=wp.float32, device=device)
    result.level_at = result.weight_at = 0
    return result


@functools.cache
def _native(layout: Layout, lanes: int) -> types.SimpleNamespace:
    if lanes < btf_code.ROW:
        view_snippet, light_snippet = btf_scalar.view_code(layout, lanes), btf_scalar.light_code(layout, lanes)
    else:
        view_snippet = by_width(lambda vector: btf_view_code.view_code(layout, lanes, vector))
        light_snippet = by_width(lambda vector: btf_light_code.light_code(layout, lanes, vector))

    @wp.func_native(view_snippet)
    def view(
        texels: wp.array(dtype=wp.uint16),
        levels: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=wp.float32),
        level_at: int,
        weight_at: int,
        place: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        alone: int,
        own: wp.array(dtype=wp.float32),
    ): ...

    @wp.func_native(light_snippet)
    def light(
        weights: wp.array(dtype=wp.float32),
        weight_at: int,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        own: wp.array(dtype=wp.float32),
        value: wp.array(dtype=wp.float32),
    ): ...

    return types.SimpleNamespace(view=view, light=light)


@functools.cache
def functions(layout: Layout, lanes: int) -> types.SimpleNamespace:
    """Return the Warp functions of a material; ``materials.base.Shader`` says what a textured one's take and give.

    Args:
        layout: What the networks look like.
        lanes: Lanes of a block: a multiple of 32 on the CPU, 1 or 4 on CUDA.

    Error: at most 1e-5 of the largest value against float64 (worst seen 5e-6, textures to 1024² and uv to ±8); held
        by test_quads_match_float64.
    """
    native = _native(layout, lanes)
    view_block, light_block = native.view, native.light
    WORDS = max(1, layout.scratch(lanes))

    @wp.func
    def view(
        material: Arguments,
        place: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        emitted: wp.array(dtype=wp.float32),
    ):
        own = wp.array(ptr=scratch, shape=(WORDS,), dtype=wp.float32)
        if count > 0:
            view_block(
                material.texels, material.levels, material.weights, material.level_at, material.weight_at, place, wo,
                active, count, 0, own,
            )  # fmt: skip

    @wp.func
    def light(
        material: Arguments,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        own = wp.array(ptr=scratch, shape=(WORDS,), dtype=wp.float32)
        light_block(material.weights, material.weight_at, wi, active, count, own, value)

    return types.SimpleNamespace(view=view, light=light, Arguments=Arguments)


def eval_lanes(lanes: int, quads: bool) -> int:
    """Return the lanes of a block of :func:`make_eval_kernel`, given the device's: a thread of CUDA has a quad."""
    return 4 if quads and lanes == 1 else lanes


def eval_scratch(layout: Layout, lanes: int) -> int:
    """Return the float32 words of scratch that :func:`make_eval_kernel`'s kernel needs for one block."""
    return layout.scratch(lanes) + 16 * lanes


@functools.cache
def make_eval_kernel(layout: Layout, lanes: int):
    """Return the kernel behind ``BTF.eval`` and ``BTF.eval_quads``: values of pairs of directions.

    Args:
        layout: What the networks look like.
        lanes: Lanes of a block (:func:`eval_lanes`).

    ``shift`` is 2 where four uv share their pair of directions and their level, else 0; ``lod_step`` is 1 where each
    row has a level of its own, 0 where all share one; ``count`` counts lanes.
    """
    native = _native(layout, lanes)
    view_block, light_block = native.view, native.light
    L = lanes
    WORDS = max(1, layout.scratch(lanes))
    # Two names, because a constant that is cast keeps the new type in the rest of the kernel.
    TOTAL = STRIDE = eval_scratch(layout, lanes)
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(**_MODULE)
    def btf_eval_kernel(
        first: int,
        slot: int,
        material: Arguments,
        uv: wp.array(dtype=wp.float32),
        lod: wp.array(dtype=wp.float32),
        lod_step: int,
        wi: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        shift: int,
        count: int,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        result: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        if wp.static(L <= 4):
            local = wp.zeros(shape=TOTAL, dtype=wp.float32)
            own = local.ptr
        I = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        O = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        Y = wp.array(ptr=own + wp.uint64(6 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        Q = wp.array(ptr=own + wp.uint64(9 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        active = wp.array(ptr=own + wp.uint64(12 * L) * FLOAT, shape=(L,), dtype=wp.int32)
        rows = wp.array(ptr=own + wp.uint64(16 * L) * FLOAT, shape=(WORDS,), dtype=wp.float32)
        lit = int(0)
        rest = wp.min(count - b * L, L)
        for l in range(L):
            item = b * L + wp.min(l, rest - 1)
            row = item >> shift
            i = safe_normalize(wp.vec3(wi[3 * row], wi[3 * row + 1], wi[3 * row + 2]))
            o = safe_normalize(wp.vec3(wo[3 * row], wo[3 * row + 1], wo[3 * row + 2]))
            for c in range(3):
                I[c * L + l] = i[c]
                O[c * L + l] = o[c]
                Y[c * L + l] = 0.0
            Q[l] = uv[2 * item]
            Q[L + l] = uv[2 * item + 1]
            Q[2 * L + l] = lod[row * lod_step]
        for l in range(L):
            # Written in any case and kept if counted: a branch on random directions is mispredicted half the time.
            active[lit] = l
            lit += wp.where(l < rest and I[2 * L + l] > 0.0 and O[2 * L + l] > 0.0, 1, 0)
        if lit > 0:
            view_block(
                material.texels, material.levels, material.weights, material.level_at, material.weight_at, Q, O,
                active, lit, wp.where(shift == 0, 1, 0), rows,
            )  # fmt: skip
            light_block(material.weights, material.weight_at, I, active, lit, rows, Y)
        for l in range(L):
            if l < rest:
                above = I[2 * L + l] > 0.0 and O[2 * L + l] > 0.0
                at = 3 * (b * L + l)
                for c in range(3):
                    result[at + c] = wp.where(above, Y[c * L + l], 0.0)

    return btf_eval_kernel


def share(layout: Layout, materials: list[Arguments]) -> list[Arguments]:
    """Return the same materials with textures, level tables and networks in one buffer of each, as copies.

    Materials of one layout then have one kernel and one set of buffers and differ in two offsets. Those too large to
    number all their texels in 31 bits are given back as they are.
    """
    tables, first, offsets = [], 0, []
    for material in materials:
        table = material.levels.numpy().copy()
        table[3::3] += first
        offsets.append((sum(map(len, tables)), len(offsets) * layout.parameters))
        tables.append(table)
        first += material.texels.size // 8
    if len(materials) < 2 or first >= 1 << 28:
        return materials
    device, shared = materials[0].texels.device, []
    texels = wp.array(np.concatenate([m.texels.numpy() for m in materials]), dtype=wp.uint16, device=device)
    weights = wp.array(np.concatenate([m.weights.numpy() for m in materials]), dtype=wp.float32, device=device)
    levels = wp.array(np.concatenate(tables), dtype=wp.int32, device=device)
    for level_at, weight_at in offsets:
        one = Arguments()
        one.texels, one.levels, one.weights = texels, levels, weights
        one.level_at, one.weight_at = level_at, weight_at
        shared.append(one)
    return shared
