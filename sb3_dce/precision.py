"""
Faster arithmetic for the time of training. The switches of PyTorch hold for a whole process or thread, so they are put back.

``bf16-matmul`` has two forms. Processors with AMX round the factors themselves (the switch of PyTorch). Those that only have
AVX-512 bf16 ignore that switch, so the layers are given rounded factors by hand, which doubles the speed of their products.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import torch as th
from torch.nn import functional as F
from torch.overrides import TorchFunctionMode

from sb3_dce.errors import SB3DCEWarning

PRECISIONS = ("float32", "bf16-matmul", "tf32")

# Layers narrower than this on either side stay float32: they take little time, and observations, actions and values keep
# their digits.
MIN_ROUNDED_WIDTH = 32


class RoundedLinear(TorchFunctionMode):
    """
    While active, wide linear layers round weights, inputs and products, and on the way back gradients, to bf16.

    Sums inside a product, biases and everything between the layers stay float32. Being seen by whoever traces or transforms
    an update, it holds in every way of running it.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return (_rounded_linear if func is F.linear else func)(*args, **(kwargs or {}))


def _rounded_linear(input: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """Arguments as those of ``torch.nn.functional.linear``."""
    if input.dtype != th.float32 or min(weight.shape) < MIN_ROUNDED_WIDTH:
        return F.linear(input, weight, bias)
    product = F.linear(input.bfloat16(), weight.bfloat16()).float()
    return product if bias is None else product + bias


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
    reason = missing_for(precision, device)
    if reason is not None:
        _warn_once(f"precision={precision!r} needs {reason}: computing in float32.")
        yield
        return
    if precision == "bf16-matmul" and not _rounds_itself():
        with RoundedLinear():
            yield
        return
    switch: Any = th.backends.cuda.matmul if precision == "tf32" else th.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = switch.fp32_precision
    switch.fp32_precision = precision.partition("-")[0]
    try:
        yield
    finally:
        switch.fp32_precision = before


@contextlib.contextmanager
def denormals_as_zero() -> Iterator[None]:
    """
    Let this thread compute numbers below 1.2e-38 (float32), which have fewer digits the smaller they are, as zero.

    They mean nothing, but take processors of Intel many times as long. CQL's gradients are full of them where its softmax all
    but ignores an action, and Adam's moments of units that no longer learn: ``benchmarks/results/denormals.md``.
    """
    before = _denormals_are_zero()
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(before)


def _denormals_are_zero() -> bool:
    return sys.float_info.min / 2 == 0.0  # PyTorch does not tell; the switch holds for Python's numbers, too


def missing_for(precision: str, device: th.device) -> str | None:
    """
    What device or PyTorch lack for a precision; as long as they lack it, training computes in float32.

    :param precision: as for :func:`matmul_precision`
    :param device: where the model lies
    :return: what it takes and is not here, in words; ``None`` if nothing
    """
    if precision == "float32":
        return None
    if precision == "tf32":
        if not hasattr(th.backends.cuda.matmul, "fp32_precision"):
            return "PyTorch 2.9 or later"
        if device.type == "cuda" and th.cuda.get_device_capability(device) >= (8, 0):
            return None
        return f"a CUDA device of compute capability 8.0 or more, the model is on {device}"
    if device.type == "cpu" and (_rounds_itself() or _processor_has("avx512_bf16")):
        return None
    return f"a processor with AVX-512 or AMX bf16, the model is on {device}"


def _rounds_itself() -> bool:
    """Whether the processor multiplies float32 matrices as bf16 when PyTorch's switch asks for it."""
    return _processor_has("amx_bf16")


def _processor_has(feature: str) -> bool:
    # absent before PyTorch 2.9 and in builds without detection: then nothing is claimed
    capabilities: Any = getattr(th.cpu, "get_capabilities", dict)()
    return bool(capabilities.get(feature, False))


@functools.cache
def _warn_once(text: str) -> None:
    # training enters here at every call of train()
    warnings.warn(text, SB3DCEWarning, stacklevel=4)
