"""The edge between callers' arrays and Warp: numpy, torch and Warp arrays go in, and the same kind comes out."""

import dataclasses

import numpy as np
import warp as wp


@dataclasses.dataclass(frozen=True)
class Kind:
    """What the caller handed in: ``"numpy"``, ``"torch"`` or ``"warp"``, and the device its data lives on."""

    name: str
    device: wp.Device

    def empty(self, shape, dtype) -> wp.array:
        """Return an uninitialised Warp array for a result of this kind."""
        return wp.empty(shape, dtype=dtype, device=self.device)

    def give(self, array: wp.array):
        """Return ``array`` as the kind the caller uses; on the CPU nothing is copied."""
        if self.name == "numpy":
            return array.numpy()
        return wp.to_torch(array) if self.name == "torch" else array


def _is_torch(value) -> bool:
    return type(value).__module__.split(".", 1)[0] == "torch"


def kind_of(value, device=None) -> Kind:
    """Return the :class:`Kind` of ``value``; numpy data goes to ``device`` (default: Warp's current device)."""
    if isinstance(value, wp.array):
        return Kind("warp", value.device)
    if _is_torch(value):
        wp.init()  # device_from_torch does not do it by itself
        return Kind("torch", wp.device_from_torch(value.device))
    return Kind("numpy", wp.get_device(device))


def take(value, name: str, shape: tuple, dtype, kind: Kind) -> wp.array:
    """Return ``value`` as a contiguous Warp array of scalar ``dtype`` on ``kind.device``.

    Nothing is copied where the data already has that type, layout and place.

    Args:
        value: numpy, torch or Warp array, or nested sequence.
        name: How error messages call it.
        shape: Expected shape; ``None`` stands for any extent. ``("n", 3)`` names extents in messages.
        dtype: Warp scalar type, as ``wp.float32``.
        kind: The kind of the call's main argument.

    Raises:
        ValueError: If the shape or the device differs.
        TypeError: If the values are not numbers.
    """
    if isinstance(value, wp.array):
        value = _scalar_view(value)
        if value.dtype != dtype:
            value = wp.array(value.numpy(), dtype=dtype, device=value.device)
        array = value if value.is_contiguous else value.contiguous()
    elif _is_torch(value):
        array = wp.from_torch(value.detach().to(wp.dtype_to_torch(dtype)).contiguous())
    else:
        data, numpy_type = np.asarray(value), wp.dtype_to_numpy(dtype)
        if data.dtype.kind not in "fiub":
            raise TypeError(f"{name} must hold numbers, got {data.dtype}; convert it to {numpy_type.__name__}")
        data = np.ascontiguousarray(data, dtype=numpy_type)
        array = wp.array(data, dtype=dtype, device=kind.device, copy=False)
    if array.device != kind.device:
        raise ValueError(f"{name} must be on {kind.device}, got {array.device}; move it there first")
    if len(array.shape) != len(shape) or any(
        isinstance(want, int) and want != got for want, got in zip(shape, array.shape, strict=True)
    ):
        wanted = ", ".join(str(n) for n in shape)
        raise ValueError(f"{name} must have shape [{wanted}], got {tuple(array.shape)}")
    return array


def _scalar_view(array: wp.array) -> wp.array:
    """View an array of Warp vectors, as ``wp.vec3``, as scalars with one more axis."""
    size = getattr(array.dtype, "_length_", 1)
    if size == 1:
        return array
    array = array if array.is_contiguous else array.contiguous()
    view = wp.array(ptr=array.ptr, shape=(*array.shape, size), dtype=array.dtype._wp_scalar_type_, device=array.device)
    view._ref = array  # the view borrows the memory
    return view


def write(target: wp.array, values) -> None:
    """Overwrite a Warp array with numpy values of its shape, or one number; on the CPU without an allocation."""
    if target.device.is_cpu:
        target.numpy()[...] = values
    else:
        target.assign(np.broadcast_to(np.asarray(values), target.shape))
