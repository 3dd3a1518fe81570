"""
Cheaper matrix products for the time of training. The switches of PyTorch are process-wide, so they are put back.
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from typing import Any

import torch as th

from sb3_dce.errors import SB3DCEWarning

PRECISIONS = ("float32", "bf16-matmul", "tf32")


@contextlib.contextmanager
def matmul_precision(precision: str, device: th.device) -> Iterator[None]:
    """
    Let float32 matrix products on this device be computed from rounded factors; sums stay float32.

    :param precision: "float32" changes nothing; "bf16-matmul" rounds to 8 bits of mantissa on processors that multiply such
        numbers; "tf32" rounds to 11 bits on a CUDA device
    :param device: where the model lies; a precision it does not have is left out, with a warning
    """
    if precision == "float32":
        yield
        return
    reason = _missing(precision, device)
    if reason is not None:
        _warn_once(f"precision={precision!r} needs {reason}: computing in float32.")
        yield
        return
    switch: Any = th.backends.cuda.matmul if precision == "tf32" else th.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = switch.fp32_precision
    switch.fp32_precision = precision.partition("-")[0]
    try:
        yield
    finally:
        switch.fp32_precision = before


def _missing(precision: str, device: th.device) -> str | None:
    """What the device lacks, None if nothing."""
    if precision == "tf32":
        if device.type == "cuda" and th.cuda.get_device_capability(device) >= (8, 0):
            return None
        return f"a CUDA device of compute capability 8.0 or more, the model is on {device}"
    if device.type == "cpu" and th.ops.mkldnn._is_mkldnn_bf16_supported():
        return None
    return f"a processor with AVX-512 or AMX bf16, the model is on {device}"


@functools.cache
def _warn_once(text: str) -> None:
    # training enters here at every call of train()
    warnings.warn(text, SB3DCEWarning, stacklevel=4)
