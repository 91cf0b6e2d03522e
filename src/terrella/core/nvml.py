"""NVML: counters of the first GPU, read through its driver's own library."""

import ctypes
from collections.abc import Callable
from typing import Any

LIBRARY = "libnvidia-ml.so.1"


class _Utilization(ctypes.Structure):
    """nvmlUtilization_t, in percent of the last sample period (a sixth of a second to a second)."""

    _fields_ = [("gpu", ctypes.c_uint), ("memory", ctypes.c_uint)]


def energy_mj() -> Callable[[], int] | None:
    """Reads the millijoules of the GPU since its driver was loaded; None without NVML or this counter."""
    read = _reader("nvmlDeviceGetTotalEnergyConsumption", ctypes.c_ulonglong)
    return None if read is None else lambda: read().value


def busy_percent() -> Callable[[], int] | None:
    """Reads in how much of the last sample period the GPU ran kernels, in percent; None without NVML or this counter."""
    read = _reader("nvmlDeviceGetUtilizationRates", _Utilization)
    return None if read is None else lambda: read().gpu


def _reader(name: str, kind: type[Any]) -> Callable[[], Any] | None:
    value, device = kind(), ctypes.c_void_p()
    try:
        nvml = ctypes.CDLL(LIBRARY)
        if nvml.nvmlInit_v2() or nvml.nvmlDeviceGetHandleByIndex_v2(0, ctypes.byref(device)):
            return None
        function = getattr(nvml, name)
        if function(device, ctypes.byref(value)):
            return None
    except (OSError, AttributeError):
        return None

    def read() -> Any:
        function(device, ctypes.byref(value))
        return value

    return read
