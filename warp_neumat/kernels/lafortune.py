"""Lafortune lobes per texel: their values, and Levenberg–Marquardt on eight texels at a time (MobileVR Eq. 6, 7).

A texel's apparent BRDF is ρ_d g_d + g_s Σ_j ρ_j (ω_oᵀ M_j ω_i)^n_j over four lobes, a base below 0 counting as 0; the
factors g_d and g_s of a pair are 1 or cosθ_i (:data:`COSINES`). Parameters of a texel, 55 float32: ρ_d (3), then for
each lobe ρ (3), M (9, row-major: rows by ω_o) and n.

The colours are linear, so that they are not searched for: after every step of the 40 others they are the non-negative
least-squares solution, exactly (variable projection). Steps solve the 55 × 55 normal equations, whose colours are not
damped. An M has a gauge, since its scale and its colour's exchange; it is held where the lobe's peak is 1.

With a ``softness`` ε > 0 the loss of a pair is 2 (√(|r|² + ε²) − ε) over its three channels, minimised by iterated
re-weighting: a smooth L1. CPU only: a fit is done once, and its state does not fit a GPU thread.
"""

import dataclasses
import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch, lafortune_code
from warp_neumat.kernels.lafortune_code import (
    CHUNK,
    DAMPING,
    EXACT,
    HARDEST,
    LANES,
    LEAST_N,
    LOBES,
    LOSS,
    MOST_N,
    SCALE,
    STALL,
    STALLED,
    STATE,
    STEPS,  # noqa: F401 (read by training)
)

NUMBERS = 3 + 13 * LOBES
"""Parameters of a texel."""
COSINES = ("none", "diffuse", "all")
"""What carries cosθ_i: nothing (Eq. 6 as it is printed), the diffuse term, or the lobes too."""
RIDGE = 1e-5
"""Weight of the squared colours in the loss, in units of the texel's mean: a peak that no pair sees stays small."""
FIRST_DAMPING = 1e-2
_LARGEST = 1e37


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Directions of N pairs as the kernels want them, padded to whole chunks with rows of 0."""

    count: int
    outer: wp.array
    """Products ω_o,a ω_i,b, [n, 9]."""
    squares: wp.array
    """Products of two of them, [n, 36]: six of ω_o by six of ω_i."""
    diffuse: wp.array
    """Factor g_d, [n]."""
    lobes: wp.array
    """Factor g_s, [n]."""

    @classmethod
    def of(cls, wi, wo, cosine: str) -> "Pairs":
        """Return the pairs of unit directions ``wi`` (to the light) and ``wo`` (to the viewer), (N, 3) each.

        Raises:
            ValueError: If the shapes differ or ``cosine`` is none of :data:`COSINES`.
        """
        wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
        if wi.ndim != 2 or wi.shape[1:] != (3,) or wi.shape != wo.shape or not len(wi):
            raise ValueError(f"wi and wo must have one shape (N, 3) with N > 0, got {wi.shape} and {wo.shape}")
        if cosine not in COSINES:
            raise ValueError(f"cosine must be one of {', '.join(COSINES)}, got {cosine!r}")
        first, second = np.triu_indices(3)
        outer = (wo[:, :, None] * wi[:, None, :]).reshape(-1, 9)
        squares = ((wo[:, first] * wo[:, second])[:, :, None] * (wi[:, first] * wi[:, second])[:, None, :]).reshape(
            -1, 36
        )
        ones = np.ones(len(wi))
        factors = (ones if cosine == "none" else wi[:, 2], wi[:, 2] if cosine == "all" else ones)
        return cls(len(wi), *(_padded(a) for a in (outer, squares, *factors)))


def _padded(rows: np.ndarray) -> wp.array:
    whole = np.zeros((-(-len(rows) // CHUNK) * CHUNK, *rows.shape[1:]), np.float32)
    whole[: len(rows)] = rows
    return wp.array(whole.ravel(), dtype=wp.float32, device="cpu")


@functools.cache
def make_fit_kernel():
    """Return the kernel that takes steps on one block of eight jobs."""

    @wp.func_native(lafortune_code.FIT)
    def fit_block(
        block: int,
        slot: int,
        job_count: int,
        texels: int,
        pairs: int,
        gauges: int,
        iterations: int,
        restart: int,
        normals_wanted: int,
        softness: float,
        tolerance: float,
        ridge: float,
        jobs: wp.array(dtype=wp.int32),
        data: wp.array(dtype=wp.float32),
        outer_array: wp.array(dtype=wp.float32),
        squares_array: wp.array(dtype=wp.float32),
        diffuse_array: wp.array(dtype=wp.float32),
        lobe_array: wp.array(dtype=wp.float32),
        gauge_array: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        state: wp.array(dtype=wp.float32),
        normals: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def lafortune_fit_kernel(
        first: int,
        slot: int,
        job_count: int,
        texels: int,
        pairs: int,
        gauges: int,
        iterations: int,
        restart: int,
        normals_wanted: int,
        softness: float,
        tolerance: float,
        ridge: float,
        jobs: wp.array(dtype=wp.int32),
        data: wp.array(dtype=wp.float32),
        outer_array: wp.array(dtype=wp.float32),
        squares_array: wp.array(dtype=wp.float32),
        diffuse_array: wp.array(dtype=wp.float32),
        lobe_array: wp.array(dtype=wp.float32),
        gauge_array: wp.array(dtype=wp.float32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        state: wp.array(dtype=wp.float32),
        normals: wp.array(dtype=wp.float32),
    ):
        fit_block(
            first + wp.tid(), slot, job_count, texels, pairs, gauges, iterations, restart, normals_wanted, softness,
            tolerance, ridge, jobs, data, outer_array, squares_array, diffuse_array, lobe_array, gauge_array, scratch,
            state, normals,
        )  # fmt: skip

    return lafortune_fit_kernel


@functools.cache
def make_evaluate_kernel():
    """Return the kernel of the values of one block of eight texels under all pairs."""

    @wp.func_native(lafortune_code.EVALUATE)
    def evaluate_block(
        block: int,
        texels: int,
        pairs: int,
        parameters: wp.array(dtype=wp.float32),
        outer_array: wp.array(dtype=wp.float32),
        diffuse_array: wp.array(dtype=wp.float32),
        lobe_array: wp.array(dtype=wp.float32),
        result: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def lafortune_evaluate_kernel(
        first: int,
        texels: int,
        pairs: int,
        parameters: wp.array(dtype=wp.float32),
        outer_array: wp.array(dtype=wp.float32),
        diffuse_array: wp.array(dtype=wp.float32),
        lobe_array: wp.array(dtype=wp.float32),
        # outputs
        result: wp.array(dtype=wp.float32),
    ):
        evaluate_block(
            first + wp.tid(), texels, pairs, parameters, outer_array, diffuse_array, lobe_array, result
        )  # fmt: skip

    return lafortune_evaluate_kernel


def make_state(matrices, exponents) -> np.ndarray:
    """Return states (J, STATE) float32, without colours, of lobes ``matrices`` (J, 4, 3, 3), ``exponents`` (J, 4)."""
    matrices, exponents = np.asarray(matrices, np.float32), np.asarray(exponents, np.float32)
    state = np.zeros((len(matrices), STATE), np.float32)
    lobes = state[:, 15:LOSS].reshape(-1, LOBES, 10)
    lobes[..., :9] = matrices.reshape(-1, LOBES, 9)
    lobes[..., 9] = np.log(np.clip(exponents, LEAST_N, MOST_N))
    state[:, DAMPING] = FIRST_DAMPING
    return state


def state_of(parameters, scale=1.0) -> np.ndarray:
    """Return the states of ``parameters`` (J, 55), colours in units of ``scale`` (J) or a number."""
    parameters = np.asarray(parameters, np.float64)
    lobes = parameters[:, 3:].reshape(-1, LOBES, 13)
    state = make_state(lobes[..., 3:12].reshape(-1, LOBES, 3, 3), lobes[..., 12])
    colours = np.concatenate([parameters[:, None, :3], lobes[..., :3]], 1) / np.reshape(scale, (-1, 1, 1))
    state[:, :15] = colours.transpose(0, 2, 1).reshape(-1, 15)
    return state


def parameters_of(state) -> np.ndarray:
    """Return the parameters (J, 55) float32 of states (J, STATE): plain units, always finite."""
    state = np.asarray(state, np.float64)
    colours = state[:, :15].reshape(-1, 3, LOBES + 1).transpose(0, 2, 1) * state[:, SCALE, None, None]
    colours = np.minimum(colours, _LARGEST)
    lobes = state[:, 15:LOSS].reshape(-1, LOBES, 10)
    exponents = np.clip(np.exp(lobes[..., 9:]), LEAST_N, MOST_N)
    rows = np.concatenate([colours[:, 1:], lobes[..., :9], exponents], -1).reshape(len(state), -1)
    return np.concatenate([colours[:, 0], rows], 1).astype(np.float32)


def restart_damping(state) -> None:
    """Make states move again, with the first damping."""
    state[:, DAMPING], state[:, STALLED] = FIRST_DAMPING, 0.0


def resting(state) -> np.ndarray:
    """Return which states (J, STATE) have converged: their steps do nothing."""
    hard = state[:, DAMPING] >= HARDEST
    return (state[:, STALLED] >= STALL) | hard | (state[:, LOSS] <= EXACT)


def fit_steps(
    data, pairs: Pairs, gauge, jobs, state: np.ndarray, *, iterations: int, restart: bool, softness=0.0, tolerance=1e-4,
    ridge=RIDGE, normals=None,
) -> None:  # fmt: skip
    """Take up to ``iterations`` steps of Levenberg–Marquardt on the texels of ``jobs``, in ``state``, in place.

    A texel's loss never increases. It rests once three steps in a row gain less than ``tolerance`` of the loss, or no
    damping gains anything. The same jobs give the same bits however many threads share them.

    Args:
        data: Values of the pairs, (N, T, 3) float32, ≥ 0.
        pairs: The N directions.
        gauge: Directions to lights, (G, 3): where a lobe's peak is looked for.
        jobs: Rows of ``state`` to work on, int32; row j is texel j mod T.
        state: (J, STATE) float32, from :func:`make_state`.
        iterations: Steps at most; 0 with ``restart`` only solves for the colours.
        restart: Solve for the colours first and forget what was converged.
        softness: ε of the loss in units of the texel's mean; 0 for least squares.
        tolerance: Relative gain that counts as none.
        ridge: Weight of the squared colours.
        normals: Receives JᵀJ and Jᵀr after the steps, (J, 55·56) float32.

    Raises:
        ValueError: If a shape does not fit.

    Error: JᵀJ and Jᵀr at most 4e-5 of their rows' scale; held by test_normal_equations_match_float64.
    """
    kind = arrays.kind_of(data, "cpu")
    values = arrays.take(data, "data", (pairs.count, "T", 3), wp.float32, kind)
    lights = arrays.take(gauge, "gauge", ("G", 3), wp.float32, kind)
    jobs = np.ascontiguousarray(jobs, np.int32)
    if state.dtype != np.float32 or state.ndim != 2 or state.shape[1] != STATE or not state.flags.c_contiguous:
        raise ValueError(f"state must be contiguous float32 of shape (J, {STATE}), got {state.dtype} {state.shape}")
    if len(jobs) and (jobs.min() < 0 or jobs.max() >= len(state)):
        raise ValueError(f"jobs must be rows of state, below {len(state)}, got {jobs.min()} … {jobs.max()}")
    padded = -(-pairs.count // CHUNK) * CHUNK
    scratch = wp.empty(lafortune_code.scratch_words(padded) * dispatch.worker_count(), dtype=wp.float32, device="cpu")
    flat = [wp.array(a, dtype=wp.float32, device="cpu", copy=False) for a in (state.reshape(-1),)]
    wanted = normals is not None
    out = normals.reshape(-1) if wanted else np.zeros(1, np.float32)
    dispatch.launch(
        make_fit_kernel(),
        dispatch.blocks(len(jobs), LANES),
        inputs=[
            len(jobs), values.shape[1], pairs.count, lights.shape[0], iterations, int(restart), int(wanted),
            float(softness), float(tolerance), float(ridge * pairs.count),
            wp.array(jobs, dtype=wp.int32, device="cpu", copy=False), values.flatten(), pairs.outer, pairs.squares,
            pairs.diffuse, pairs.lobes, lights.flatten(), scratch,
        ],
        outputs=[*flat, wp.array(out, dtype=wp.float32, device="cpu", copy=False)],
        device="cpu",
        grain=1,
    )  # fmt: skip


def normal_equations(data, pairs: Pairs, parameters, *, scale=1.0, softness=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return JᵀWJ (T, 55, 55) and JᵀWr (T, 55) of the texels at ``parameters``, for means ``scale``.

    Order of the unknowns: colours [channel][diffuse, lobes], then for each lobe M (9) and ln n. W = 1, or the weights
    1/√(|r|² + ε²) of a ``softness`` ε.
    """
    state = state_of(parameters, scale)
    count = len(state)
    normals = np.zeros((count, 55 * 56), np.float32)
    fit_steps(
        data, pairs, np.float32([[0, 0, 1]]), np.arange(count), state, iterations=0, restart=False, softness=softness,
        normals=normals,
    )  # fmt: skip
    return normals[:, : 55 * 55].reshape(count, 55, 55), normals[:, 55 * 55 :]


def evaluate(parameters, wi, wo, *, cosine: str) -> np.ndarray:
    """Return the values of ``parameters`` (T, 55) under directions ``wi``, ``wo`` (N, 3), shape (N, T, 3) float32.

    Error: at most 1.2e-5 relative for n up to 42 and 6e-5 for n = 200, since n multiplies the rounding of a base; held
    by test_values_match_float64.

    Raises:
        ValueError: If a shape does not fit or ``cosine`` is none of :data:`COSINES`.
    """
    pairs = Pairs.of(wi, wo, cosine)
    kind = arrays.kind_of(parameters, "cpu")
    rows = arrays.take(parameters, "parameters", ("T", NUMBERS), wp.float32, kind)
    texels = rows.shape[0]
    result = wp.empty(pairs.count * texels * 3, dtype=wp.float32, device="cpu")
    dispatch.launch(
        make_evaluate_kernel(),
        dispatch.blocks(texels, LANES),
        inputs=[texels, pairs.count, rows.flatten(), pairs.outer, pairs.diffuse, pairs.lobes],
        outputs=[result],
        device="cpu",
    )
    return result.numpy().reshape(pairs.count, texels, 3)
