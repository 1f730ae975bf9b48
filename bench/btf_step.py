"""One training step of a BTF network: loss and all gradients by the fused kernel, beside plain torch with autograd.

1024 quads of a 128² material, one mip (MobileVR §4.3, 4.4): the student with all of Eq. 5's terms, NeuMIP and the
128-wide teacher with the first alone. Both sides leave the gradients of textures and networks. Torch is written as its
users would: ``embedding_bag`` for the bilinear rows, whose texels and weights it is given ready, ``linear``, autograd.
What comes from the teacher is given to both; Adam is the same on both sides and left out.

``error`` is the largest deviation of a gradient from torch in float64, over the largest, without quads of which a
hidden unit or a difference of outputs lies so near 0 that rounding decides its slope. ``gflops``: matrix products only,
forward and backward.
"""

import numpy as np

from bench.harness import interleave, track
from warp_neumat.kernels import dispatch

COLUMNS = [
    "network", "quads", "workers", "ms", "quads_per_ms", "gflops", "peer", "peer_ms", "ratio", "error", "peer_error",
]  # fmt: skip

NETWORKS = {"student": "coarse-to-fine", "neumip": "neumip", "teacher": "teacher"}
"""Name → variant of the model."""

QUADS, SIDE = 1024, 128
LAMBDAS = (0.1, 0.1)
SIGMA = 0.1
MARGIN = 1e-4
"""Least distance from a kink of what the error is taken on, in units of order one."""


def _model(network: str, side: int):
    from warp_neumat.models import btf
    from warp_neumat.models.btf_config import VARIANTS, BTFConfig

    variant = NETWORKS[network]
    config = {"width": side, "height": side, "mips": 1, "teacher": "none", **VARIANTS[variant]}
    return btf.build(BTFConfig(**config, variant=variant), seed=0)


class Problem:
    """A batch of quads for a model: what the fused step takes, and the rows and weights that torch gathers."""

    def __init__(self, model, quads: int, *, taught: bool, seed: int = 1):
        import torch

        from warp_neumat.models.btf import CORNERS

        rng = np.random.default_rng(seed)
        self.model, self.quads, self.taught = model, quads, taught
        d = rng.normal(size=(2, quads, 3))
        d[..., 2] = np.abs(d[..., 2]) + 0.05
        wi, wo = torch.from_numpy((d / np.linalg.norm(d, axis=2, keepdims=True)).astype(np.float32))
        rows, width1, width2 = model.shape.hints

        def draw(*shape):
            return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

        place = rng.random((quads, 4))
        place[:, 2], place[:, 3] = 1.0, 0.0
        self.batch = [model.angles(wi, wo), torch.from_numpy(place.astype(np.float32)), 1 + draw(quads, 12)]
        if taught:
            self.batch += [1 + draw(quads, 12), 0.3 * draw(quads, rows * width1), 0.3 * draw(quads, 4 * width2)]
        _, w, h = model.levels[0]
        corner = place[:, None, :2] + np.array(CORNERS) / (w, h)
        self.taps = {"fine": _taps(corner.reshape(-1, 2), w, h)}
        if model.config.coarse:
            self.taps["coarse"] = _taps(place[:, :2], *model.levels[1][1:])

    def kept(self, rows) -> "Problem":
        """Return the problem of some quads."""
        fewer = object.__new__(Problem)
        fewer.model, fewer.quads, fewer.taught = self.model, len(rows), self.taught
        fewer.batch = [part[rows] for part in self.batch]
        fewer.taps = {}
        for name, taps in self.taps.items():
            per = 4 if name == "fine" else 1
            fewer.taps[name] = tuple(t.view(self.quads, per, 4)[rows].reshape(-1, 4) for t in taps)
        return fewer

    def step(self, parts: int):
        """Return the fused step."""
        from warp_neumat.ops.btf import BTFStep

        model, taught = self.model, self.taught
        with_teacher = {"sigma": SIGMA, "lambdas": LAMBDAS} if taught else {}
        table, net = model.texels.detach().clone(), model.net.detach().clone()
        return BTFStep(model.shape, model.levels, table, net, quads=self.quads, parts=parts, **with_teacher)

    def leaves(self, dtype):
        """Return textures and packed networks for torch."""
        return [p.detach().to(dtype).clone().requires_grad_() for p in (self.model.texels, self.model.net)]

    def torch_step(self, texels, net, *, margins: bool = False):
        """Leave gradients in ``texels`` and ``net``; with ``margins`` return each quad's least distance from a kink."""
        import torch
        from torch.nn.functional import embedding_bag, hardswish, linear, pad

        model, dtype = self.model, texels.dtype
        config, layers = model.config, model.layers(net)
        between = {"relu": torch.relu, "hardswish": hardswish}[config.activation]
        kinks = {"relu": (0.0,), "hardswish": (-3.0, 3.0)}[config.activation]
        angles, _, target, *taught = (part.to(dtype) for part in self.batch)
        found: list = []
        texels.grad = net.grad = None

        def near(x, places=(0.0,)):
            if margins:
                distance = torch.stack([(x.detach() - place).abs() for place in places]).amin(0)
                found.append(distance.reshape(self.quads, -1).amin(1))

        def fetch(name, channels):
            at, w, h = model.levels[0 if name == "fine" else 1]
            rows, weights = self.taps[name]
            table = texels[at : at + w * h * channels].view(-1, channels)
            return embedding_bag(rows, table, mode="sum", per_sample_weights=weights.to(dtype))

        def hidden(x, weight, bias):
            x = linear(x, weight, bias)
            near(x, kinks)
            return between(x)

        head, z1, deep = angles, None, len(config.coarse)
        if deep:
            head = torch.cat([angles, fetch("coarse", config.coarse_channels)], 1)
            for layer in layers[:deep]:
                head = hidden(head, *layer)
            z1 = head
        x = torch.cat([head.repeat_interleave(4, 0), fetch("fine", config.channels)], 1)
        for number, layer in enumerate(layers[deep:-1], 1):
            x = hidden(x, *layer)
            if not deep and number == model.shape.middle:
                z1 = x
        y = linear(x, *layers[-1]).view(-1, 12)
        near(y - target)
        loss = (y - target).abs().mean()
        if taught:
            answer, *hints = taught
            near(y - answer)
            loss = loss + SIGMA * (y - answer).abs().mean()
            for weight, z, hint in zip(LAMBDAS, (z1, x), hints, strict=True):
                hint = hint.view(len(z), -1)
                loss = loss + weight * ((pad(z, (0, hint.shape[1] - z.shape[1])) - hint) ** 2).mean()
        loss.backward()
        return torch.stack(found).amin(0) if margins else None


def _taps(uv: np.ndarray, width: int, height: int):
    """Return rows and weights of bilinear taps for torch."""
    import torch

    from bench._btf_networks import taps

    return tuple(torch.from_numpy(part) for part in taps(uv.astype(np.float32), width, height))


def _errors(model, quads: int, taught: bool) -> tuple[float, float]:
    """Return the errors of the fused step's gradients and of torch's in float32."""
    import torch

    from warp_neumat.kernels.btf_train import QUADS as UNIT

    problem = Problem(model, 4 * quads, taught=taught, seed=2)
    wide = problem.leaves(torch.float64)
    kept = torch.nonzero(problem.torch_step(*wide, margins=True) > MARGIN).flatten()
    problem = problem.kept(kept[: min(quads, len(kept) // UNIT * UNIT)])
    problem.torch_step(*wide)
    single = problem.leaves(torch.float32)
    problem.torch_step(*single)
    step = problem.step(2)
    step.run(*problem.batch)

    def error(found):
        return max(float((f - e.grad).abs().max() / e.grad.abs().max()) for f, e in zip(found, wide, strict=True))

    return error((step.table_gradient, step.weight_gradient)), error([leaf.grad for leaf in single])


def rows(*, device: str, quick: bool):
    """Yield a row per network and number of workers."""
    import torch

    if device != "cpu":
        raise ValueError(f"device must be cpu, where the fused step runs, got {device}")
    quads, side, rounds = (256, 32, 3) if quick else (QUADS, SIDE, 25)
    threads, most = torch.get_num_threads(), dispatch.worker_count()
    choices = [(name, workers) for name in NETWORKS for workers in ([1] if quick else sorted({1, most}))]
    models = {name: _model(name, side) for name in NETWORKS}
    errors = {name: _errors(model, quads, name == "student") for name, model in models.items()}
    try:
        for name, workers in track(choices, "training steps"):
            dispatch.set_worker_count(workers)
            torch.set_num_threads(workers)
            problem = Problem(models[name], quads, taught=name == "student")
            step, leaves = problem.step(workers), problem.leaves(torch.float32)

            def ours(step=step, batch=problem.batch):
                step.run(*batch)
                return step.table_gradient, step.weight_gradient

            calls = {"ours": ours, "torch": lambda problem=problem, leaves=leaves: problem.torch_step(*leaves)}
            seconds = interleave(calls, rounds)
            yield {
                "network": name,
                "quads": quads,
                "workers": workers,
                "ms": 1e3 * seconds["ours"],
                "quads_per_ms": quads / seconds["ours"] / 1e3,
                "gflops": 6 * problem.model.shape.products * quads / seconds["ours"] / 1e9,
                "peer": "torch",
                "peer_ms": 1e3 * seconds["torch"],
                "ratio": seconds["torch"] / seconds["ours"],
                "error": errors[name][0],
                "peer_error": errors[name][1],
            }
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)
