"""The fitting side of every model. A model is a module; the registry imports it only when it is asked for.

What :mod:`warp_neumat.training` relies on, of every module: ``DATA`` (kind of source, which decides who trains it),
``configure(source, options) -> config``, ``build(config, seed, …) -> model`` (a ``torch.nn.Module``) and
``DEFAULT_STEPS``; of a model: ``to_asset(…)`` and ``statistics()``.

Models of reflectance (``DATA = "brdf"`` and ``"btf"``) are trained by :mod:`warp_neumat.training.loop` and further have
``from_asset(tensors, config)``, ``prepare(samples) -> batch``, ``predict(batch)``, ``gradients(batch, loss)``,
``event_samples()``, ``stages()``, ``trainable(stage)``, ``rates(parameters)``, ``step_threads``, ``begin``, ``enter``,
``event``, and those of BRDFs ``evaluate(*inputs)``;
:class:`warp_neumat.models.neubrdf.NeuBRDF` says what each does. Models of texture sets (``"maps"`` and
``"block_maps"``) have a trainer each that knows their buffers: :mod:`warp_neumat.training.block_loop` and
:mod:`warp_neumat.training.ntbc_loop`.
"""

import difflib
import importlib

REGISTRY = {
    "neubrdf": "warp_neumat.models.neubrdf",
    "bcf": "warp_neumat.models.bcf",
    "btf": "warp_neumat.models.btf",
    "ntbc": "warp_neumat.models.ntbc",
}
"""Module of every model, by the name that ``neumat fit --model`` takes and assets carry as ``kind``."""


def find(name: str):
    """Return the module of model ``name``.

    Raises:
        ValueError: If there is no such model; names the nearest.
    """
    if name not in REGISTRY:
        close = difflib.get_close_matches(name, REGISTRY, n=1, cutoff=0.0)[0]
        raise ValueError(f"no model {name!r}; nearest: {close}; known: {', '.join(REGISTRY)}")
    return importlib.import_module(REGISTRY[name])
