"""Checkpoints of a fit: tensors, where it stood, and the facts that a run resuming it must share."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes

from warp_neumat.io.asset import FormatError
from warp_neumat.io.atomic import replacing


def save(path: Path, tensors: dict[str, torch.Tensor], state: dict, facts: dict) -> None:
    """Write a checkpoint, whole or not at all."""
    metadata = {"state": json.dumps(state), "facts": json.dumps(facts, sort_keys=True)}
    with replacing(path) as temporary:
        temporary.write_bytes(to_bytes({k: v.contiguous() for k, v in tensors.items()}, metadata=metadata))


def load(path: Path, facts: dict) -> tuple[dict[str, torch.Tensor], dict]:
    """Return (tensors, state) of a checkpoint.

    Raises:
        FormatError: If it is no checkpoint, or was made by a fit with other settings.
    """
    anew = "fit again without --resume"
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        state, saved = json.loads(metadata["state"]), json.loads(metadata["facts"])
    except (SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise FormatError(path, "file", f"no readable checkpoint ({error})", anew) from None
    mine = json.loads(json.dumps(facts))
    for key in mine.keys() | saved.keys():
        if mine.get(key) != saved.get(key):
            rule = f"was {saved.get(key)!r} when it was saved, now {mine.get(key)!r}"
            raise FormatError(path, key, rule, f"use the same settings, or {anew}")
    return tensors, state


def optimiser_tensors(optimiser, parameters) -> dict[str, torch.Tensor]:
    """Return the state of an optimiser as tensors by name, ``optimiser.NUMBER.KEY``."""
    return {
        f"optimiser.{number}.{key}": value
        for number, parameter in enumerate(parameters)
        for key, value in optimiser.state.get(parameter, {}).items()
    }


def restore_optimiser(optimiser, parameters, tensors: dict[str, torch.Tensor]) -> None:
    """Put back what :func:`optimiser_tensors` returned; other tensors are ignored."""
    for number, parameter in enumerate(parameters):
        prefix = f"optimiser.{number}."
        state = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
        if state:
            optimiser.state[parameter] = state
