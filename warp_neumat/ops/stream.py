"""Which CUDA stream a Warp launch goes to when its data are torch's."""

import contextlib

import warp as wp


def torch_stream(device):
    """Return a context in which Warp launches on torch's current stream of ``device``, so that neither runs ahead."""
    if device.is_cpu:
        return contextlib.nullcontext()
    import torch

    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(wp.device_to_torch(device))))
