"""Half precision, where a device computes it natively."""

import torch


def half_precision(device: torch.device) -> torch.autocast:
    """bfloat16 where the device computes it natively."""
    native = half_is_native(device)
    return torch.autocast(device.type if native else "cpu", torch.bfloat16, enabled=native)


def half_is_native(device: torch.device) -> bool:
    avx512 = device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX512"
    return device.type == "cuda" or avx512 and _cpu_has_bf16()


def _cpu_has_bf16() -> bool:
    """Whether in hardware: emulated by oneDNN it is 2.7 times slower than float32."""
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
