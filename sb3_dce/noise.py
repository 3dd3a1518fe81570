"""Randomness as data: what an update needs is declared here and drawn before it runs."""

from __future__ import annotations

from dataclasses import dataclass

import torch as th

from sb3_dce.checks import check_choice


@dataclass(frozen=True)
class NoiseSpec:
    """
    Random numbers an update needs.

    :param kind: "normal", "uniform" in [0, 1), or "dropout" (0 with probability ``rate``, else 1 / (1 - rate))
    :param shape: shape of the tensor
    :param rate: dropout rate
    :raises ConfigError: if the kind is none of these
    """

    kind: str
    shape: tuple[int, ...]
    rate: float = 0.0

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, ("normal", "uniform", "dropout"))

    def draw(self, generator: th.Generator, device: th.device, dtype: th.dtype) -> th.Tensor:
        """
        Fresh numbers of this kind for one update, made on the device itself.

        :param generator: source of the randomness, of the same device
        :param device: where the tensor lies
        :param dtype: floating-point type
        :return: tensor of the given shape
        """
        if self.kind == "normal":
            return th.randn(self.shape, generator=generator, device=device, dtype=dtype)
        drawn = th.rand(self.shape, generator=generator, device=device, dtype=dtype)
        return drawn if self.kind == "uniform" else (drawn >= self.rate).to(dtype) / (1.0 - self.rate)
