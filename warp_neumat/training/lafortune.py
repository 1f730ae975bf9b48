"""The analytic baseline of a BTF: four Lafortune lobes fitted to every texel's apparent BRDF (MobileVR §5.3, Table 1).

Non-linear least squares finds the nearest valley, so the fit looks at several: short runs from the sets of lobes in
:func:`starts`, the best of them to the end, then the lobes of each texel's neighbours, since a good set found in one
place is one for the material. The figure that counts is L1, so that steps minimise a smooth L1 by re-weighted squares.
Differs from the paper, which minimises squares: ``loss="l2"``.

The data carries cosθ_i. Eq. 6 as printed gives it to no term; here the diffuse term has it, as a lambertian surface
does, and lobes find their own (``cosine``). Held-out L1 × 10³ of the micro-geometries weave, leather, carpet, wood at
24²: none 7.63, 4.16, 5.72, 8.56; diffuse 7.61, 3.94, 5.71, 7.38; all 8.40, 3.57, 6.42, 6.55; and diffuse by squares
8.48, 4.65, 6.00, 10.27.

Units: values are those of the source, [1/sr] × cosθ_i; a texel is fitted in units of its mean, so that dark texels are
fitted as well as bright ones.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from warp_neumat.io.btf_source import BTFSource, checked_pairs
from warp_neumat.kernels import lafortune as kernel

BAND_BYTES = 1 << 29
"""Data that is held at once; a larger material is fitted in bands of rows."""
PROBE = 8
"""Steps that each start is given."""
THIN = 3
"""Every how many pairs the starts look at: enough to tell good ones from bad ones."""
ROUND = 10
"""Steps between two looks at which texels still move."""
SOFTNESS = 0.05
"""ε of the smooth L1, in units of a texel's mean."""
SLICES_BYTES = 1 << 27


@dataclasses.dataclass(frozen=True)
class LafortuneFit:
    """Lobes of every texel of a material."""

    parameters: np.ndarray
    """(height, width, 55) float32: ρ_d (3), then for each lobe ρ (3), M (9, row-major) and n."""
    lights: np.ndarray
    """Directions of the source, (L, 3)."""
    views: np.ndarray
    """Directions of the source, (V, 3)."""
    cosine: str
    """What carries cosθ_i, one of :data:`warp_neumat.kernels.lafortune.COSINES`."""
    pairs: np.ndarray
    """Pairs (N, 2) it was fitted to."""
    seconds: float
    """Time of the fit, without the source's."""
    steps: float
    """Steps that a texel took, mean."""
    converged: float
    """Share of texels that came to rest before the steps ran out."""

    @property
    def bytes(self) -> int:
        """Size in float32."""
        return 4 * self.parameters.size

    def evaluate(self, pairs) -> np.ndarray:
        """Return the slices of ``pairs`` (N, 2) of indices (light, view), (N, height, width, 3) float32.

        Raises:
            ValueError: If a pair is none of the source's.
        """
        pairs = checked_pairs(pairs, len(self.lights), len(self.views))
        return self.value(self.lights[pairs[:, 0]], self.views[pairs[:, 1]])

    def value(self, wi, wo) -> np.ndarray:
        """Return the slices for directions (N, 3) each, (N, height, width, 3) float32; 0 below the horizon."""
        wi, wo = np.asarray(wi, np.float32), np.asarray(wo, np.float32)
        height, width, _ = self.parameters.shape
        if not len(wi):
            return np.zeros((0, height, width, 3), np.float32)
        found = kernel.evaluate(self.parameters.reshape(-1, kernel.NUMBERS), wi, wo, cosine=self.cosine)
        found[(wi[:, 2] <= 0) | (wo[:, 2] <= 0)] = 0.0
        return found.reshape(-1, height, width, 3)

    def l1(self, source: BTFSource, pairs) -> float:
        """Return the mean |fit − source| over ``pairs`` (N, 2), texels and channels [1/sr]."""
        pairs = checked_pairs(pairs, len(self.lights), len(self.views))
        if not len(pairs):
            raise ValueError("pairs must hold at least one pair (light, view), got none")
        total, step = 0.0, max(1, SLICES_BYTES // max(1, 12 * source.width * source.height))
        for first in range(0, len(pairs), step):
            part = pairs[first : first + step]
            total += np.abs(self.evaluate(part) - source.slices(part)).sum(dtype=np.float64)
        return total / (len(pairs) * 3 * source.width * source.height)


def stratified_pairs(lights, views, count: int, seed: int) -> np.ndarray:
    """Return about ``count`` different pairs (N, 2) of indices (light, view), all pairs where there are no more.

    Every light is seen from as many views: one at random out of each of equally many, ranked by the angle to the
    light's mirror direction, so that every light's highlight is looked at and all pairs are as likely.
    """
    lights, views = np.asarray(lights, np.float64), np.asarray(views, np.float64)
    if count < 1:
        raise ValueError(f"pairs must be at least 1, got {count}")
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(len(lights))[:count])
    strata = min(len(views), max(1, round(count / len(lights))))
    ranked = np.argsort(-(lights[chosen] * (-1, -1, 1)) @ views.T, axis=1, kind="stable")
    edges = np.arange(strata + 1) * len(views) // strata
    place = edges[:-1] + np.floor(rng.random((len(chosen), strata)) * np.diff(edges)).astype(np.int64)
    seen = np.take_along_axis(ranked, place, 1)
    return np.stack([np.repeat(chosen, strata), seen.ravel()], 1)


def _normals(data, wi, wo) -> np.ndarray:
    """Return the mean half vector (T, 3) of each texel under its values squared: where it faces, roughly."""
    half = wi.astype(np.float64) + wo
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-6)
    light = data.max(2)
    light = light / np.maximum(light.max(0), 1e-30)
    found = (light * light).T @ half + (0.0, 0.0, 1e-6)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def starts(normals) -> tuple[np.ndarray, np.ndarray]:
    """Return the sets of lobes that are tried, matrices (S, T, 4, 3, 3) and exponents (S, T, 4), for normals (T, 3).

    M reflects (mirror), returns (retro), reflects weakly (forward), or takes both cosines (diffuse-like, n = 1 … 2).
    """
    up = np.broadcast_to(np.diag([0.0, 0.0, 1.0]), (len(normals), 3, 3))
    facing = normals[:, :, None] * normals[:, None, :]
    mirror = 2.0 * facing - np.eye(3)

    def flat(x, y, z):
        return np.broadcast_to(np.diag([x, y, z]).astype(float), up.shape)

    sets = (
        ((flat(-1, -1, 1), 20), (flat(1, 1, 1), 6), (flat(-0.5, -0.5, 0.9), 3), (flat(0.1, 0.1, 1), 1)),
        ((mirror, 60), (mirror, 8), (flat(1, 1, 1), 3), (facing, 1.5)),
        ((mirror, 25), (flat(-0.8, -0.8, 0.3), 6), (flat(0.7, 0.7, 0.7), 2), (facing, 1)),
        ((flat(-1, 1, 1), 12), (flat(1, -1, 1), 12), (flat(-1, -1, 1), 10), (flat(0.3, 0.3, 1), 1.5)),
        ((mirror, 150), (mirror, 20), (mirror, 4), (flat(0.5, 0.5, 1), 1)),
    )  # fmt: skip
    matrices = np.stack([np.stack([m for m, _ in lobes], 1) for lobes in sets])
    exponents = np.array([[n for _, n in lobes] for lobes in sets], np.float64)
    return matrices, np.broadcast_to(exponents[:, None], matrices.shape[:3])


class _Band:
    """Texels of some rows and the data that they are fitted to."""

    def __init__(self, data, rows: int, wi, wo, lights, cosine: str, softness: float, ridge: float):
        self.data = data.reshape(len(data), -1, 3)
        self.rows, self.texels = rows, self.data.shape[1]
        self.wi, self.wo, self.lights = wi, wo, np.ascontiguousarray(lights, np.float32)
        self.cosine, self.softness, self.ridge = cosine, softness, ridge
        self.table = kernel.Pairs.of(wi, wo, cosine)

    def steps(self, state, jobs, iterations: int, restart: bool):
        """Take steps in ``state``."""
        kernel.fit_steps(
            self.data, self.table, self.lights, jobs, state, iterations=iterations, restart=restart,
            softness=self.softness, ridge=self.ridge,
        )  # fmt: skip

    def thinned(self, step: int) -> _Band:
        """Return the band with each ``step``-th pair only, enough to tell good starts from bad ones."""
        if len(self.data) < 256 * step:
            return self
        data = np.ascontiguousarray(self.data[::step]).reshape(-1, self.rows, self.texels // self.rows, 3)
        return _Band(
            data, self.rows, self.wi[::step], self.wo[::step], self.lights, self.cosine, self.softness, self.ridge
        )

    def best_start(self) -> np.ndarray:
        """Return the states (T, STATE) of each texel's best start."""
        matrices, exponents = starts(_normals(self.data, self.wi, self.wo))
        state = kernel.make_state(matrices.reshape(-1, 4, 3, 3), exponents.reshape(-1, 4))
        self.steps(state, np.arange(len(state)), PROBE, True)
        tried = state.reshape(len(matrices), self.texels, -1)
        best = tried[..., kernel.LOSS].argmin(0)
        return np.ascontiguousarray(tried[best, np.arange(self.texels)])

    def settle(self, state, iterations: int, jobs=None) -> None:
        """Take steps until every texel rests, or ``iterations`` are taken."""
        jobs = np.arange(self.texels) if jobs is None else jobs
        for first in range(0, iterations, ROUND):
            if not len(jobs):
                break
            self.steps(state, jobs, min(ROUND, iterations - first), False)
            jobs = jobs[~kernel.resting(state[jobs])]

    def ask_neighbours(self, state, iterations: int) -> int:
        """Try the lobes of the four neighbours on every texel; return how many took them over."""
        picture = np.arange(self.texels).reshape(self.rows, -1)
        taken = np.zeros(self.texels, bool)
        for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
            other = np.ascontiguousarray(state[np.roll(picture, shift, axis).ravel()])
            kernel.restart_damping(other)
            self.steps(other, np.arange(self.texels), 3, True)
            better = other[:, kernel.LOSS] < 0.999 * state[:, kernel.LOSS]
            state[better] = other[better]
            taken |= better
        self.settle(state, iterations, np.flatnonzero(taken))
        return int(taken.sum())


def fit_lafortune(
    source: BTFSource,
    *,
    pairs=2114,
    iterations: int = 60,
    neighbours: int = 2,
    seed: int = 0,
    cosine: str = "diffuse",
    loss: str = "l1",
    ridge: float = kernel.RIDGE,
    progress: Callable[[float, str], None] | None = None,
) -> LafortuneFit:
    """Fit four Lafortune lobes to every texel of ``source`` (MobileVR §5.3).

    Args:
        source: The material.
        pairs: How many pairs (light, view) to fit to, drawn by :func:`stratified_pairs`; or the pairs, (N, 2).
        iterations: Steps of Levenberg–Marquardt at most, after the starts', and again after each look at neighbours.
        neighbours: Times that a texel tries its neighbours' lobes.
        seed: Of the pairs.
        cosine: What carries cosθ_i, one of :data:`warp_neumat.kernels.lafortune.COSINES`. Eq. 6 as printed is "none".
        loss: ``"l1"``, the smooth L1, or ``"l2"``, plain least squares.
        ridge: Weight of the squared peaks of lobes in the loss: less of it fits the pairs better, and others worse.
        progress: ``progress(fraction, text)``.

    Raises:
        ValueError: If an argument is out of range or the source's values are not finite.
    """
    if cosine not in kernel.COSINES:
        raise ValueError(f"cosine must be one of {', '.join(kernel.COSINES)}, got {cosine!r}")
    for name, number in (("iterations", iterations), ("neighbours", neighbours)):
        if number < 0:
            raise ValueError(f"{name} must be at least 0, got {number}")
    if loss not in ("l1", "l2"):
        raise ValueError(f"loss must be l1 or l2, got {loss!r}")
    if np.ndim(pairs) == 0:
        pairs = stratified_pairs(source.lights, source.views, int(pairs), seed)
    pairs = checked_pairs(pairs, len(source.lights), len(source.views))
    if not len(pairs):
        raise ValueError("pairs must hold at least one pair (light, view), got none")
    report = progress or (lambda fraction, text: None)
    wi, wo = source.lights[pairs[:, 0]], source.views[pairs[:, 1]]
    height, width = source.height, source.width
    rows = max(1, min(height, BAND_BYTES // (12 * len(pairs) * width)))
    parameters = np.empty((height, width, kernel.NUMBERS), np.float32)
    seconds, steps, converged = 0.0, 0.0, 0
    for top in range(0, height, rows):
        bottom, share = min(height, top + rows), (top / height, (min(height, top + rows) - top) / height)
        data = _read(source, pairs, slice(top, bottom))

        def tell(part, text, share=share):
            report(share[0] + share[1] * part, text)

        begun = time.perf_counter()
        band = _Band(data, bottom - top, wi, wo, source.lights, cosine, SOFTNESS if loss == "l1" else 0.0, ridge)
        tell(0.0, "starts")
        state = band.thinned(THIN).best_start()
        tell(0.3, "steps")
        kernel.restart_damping(state)
        band.steps(state, np.arange(band.texels), 0, True)
        band.settle(state, iterations)
        for n in range(neighbours):
            tell(0.6 + 0.4 * n / neighbours, "neighbours")
            band.ask_neighbours(state, iterations)
        parameters[top:bottom] = kernel.parameters_of(state).reshape(bottom - top, width, -1)
        seconds += time.perf_counter() - begun
        steps += float(state[:, kernel.STEPS].sum())
        converged += int(kernel.resting(state).sum())
    report(1.0, "done")
    texels = height * width
    return LafortuneFit(
        parameters, source.lights, source.views, cosine, pairs, seconds, steps / texels, converged / texels
    )


def _read(source: BTFSource, pairs, rows: slice) -> np.ndarray:
    """Return the values (N, rows, width, 3) of some rows under ``pairs``."""
    step = max(1, SLICES_BYTES // max(1, 12 * source.width * source.height))
    parts = []
    for first in range(0, len(pairs), step):
        part = pairs[first : first + step]
        slices = source.slices(part)[:, rows]
        if not np.isfinite(slices).all():
            worst = part[~np.isfinite(slices).all((1, 2, 3))][0]
            raise ValueError(f"{source.name}: the slice of light {worst[0]}, view {worst[1]} holds a value not finite")
        parts.append(slices)
    return np.ascontiguousarray(np.concatenate(parts), np.float32)
