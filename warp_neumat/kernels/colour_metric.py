"""Metrics of colour differences: symmetric G, so that a difference δ of encoded colours counts δᵀGδ.

``rgb`` is the plain squared difference. ``luma`` tells luminance from chrominance: 3 (yᵀδ)² + β |δ − mean(δ)|², with y
the shares of BT.601 and the distance from the grey axis. A grey difference counts as it does in ``rgb``, and a change
of hue β times what it does there, which is what BC's lines between two endpoints get wrong visibly (NTBC §5,
discoloration).
"""

import numpy as np

METRICS = ("rgb", "luma")
"""Names of the metrics."""

_SHARES = (0.299, 0.587, 0.114)
_CHROMINANCE = 2.0


def colour_metric(name: str, channels: int, colour: bool) -> np.ndarray:
    """Return G of a plane, (4, 4) float32, zero beyond its channels.

    Args:
        name: One of :data:`METRICS`.
        channels: Channels of the plane, 1 to 4; a fourth counts by itself.
        colour: Whether the first three are red, green and blue; other planes always have the identity.

    Raises: ValueError: If the name is unknown.
    """
    if name not in METRICS:
        raise ValueError(f"metric must be one of {', '.join(METRICS)}, got {name!r}")
    metric = np.zeros((4, 4))
    metric[:channels, :channels] = np.eye(channels)
    if name == "luma" and colour and channels >= 3:
        shares = np.array(_SHARES)
        metric[:3, :3] = 3.0 * np.outer(shares, shares) + _CHROMINANCE * (np.eye(3) - 1.0 / 3.0)
    return metric.astype(np.float32)


def plane_metrics(name: str, planes, channels) -> np.ndarray:
    """Return G of each plane, (planes, 4, 4) float32.

    Args:
        name: One of :data:`METRICS`.
        planes: (components, numbers of channels) of each plane.
        channels: The channels, each a dictionary with ``map`` and ``component``.
    """
    found = []
    for components, numbers in planes:
        maps = {channels[k]["map"] for k in numbers[:3]}
        colour = len(maps) == 1 and [channels[k]["component"] for k in numbers[:3]] == ["r", "g", "b"]
        found.append(colour_metric(name, components, colour))
    return np.stack(found)
