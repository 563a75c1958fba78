"""In which precision networks learn."""

from __future__ import annotations

import functools

import torch


def reduced_precision(device: torch.device) -> torch.autocast:
    """A context in which networks compute in bfloat16, where the device has instructions for it.

    Without them a processor imitates it: a step of the paper's CCN then takes 14 times as long as in single precision
    (one core with AVX2). There the context changes nothing.
    """
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=device.type != "cpu" or _processor_has_bfloat16())


@functools.cache
def _processor_has_bfloat16() -> bool:
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
