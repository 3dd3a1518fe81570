"""
Bridge between Stable-Baselines3's modules and the pure update.

The parameters of a network lie in one flat vector of which the module's own tensors are views, and so do the moments of
its optimizer. The update reads and writes the vectors; ``state_dict()``, ``predict`` and ``save`` see the modules.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.utils import update_learning_rate
from torch import nn
from torch.func import functional_call

from sb3_dce.optimizers import AdamSettings, Learner


class _Method(nn.Module):
    """A module whose ``forward`` is a chosen method of another one (``functional_call`` only calls ``forward``)."""

    def __init__(self, module: nn.Module, method: str) -> None:
        super().__init__()
        self.module = module
        self.method = method

    def forward(self, *args: Any) -> Any:
        return getattr(self.module, self.method)(*args)


class PureNet:
    """
    A network as a function of its flat parameter vector.

    :param module: Stable-Baselines3 module
    :param method: method that is called
    """

    def __init__(self, module: nn.Module, method: str = "forward") -> None:
        self._wrapper = _Method(module, method)
        named = dict(self._wrapper.named_parameters())
        self._names = list(named)
        self._shapes = [parameter.shape for parameter in named.values()]
        self._sizes = [parameter.numel() for parameter in named.values()]
        owners = dict(self._wrapper.named_modules())
        places = [name.rpartition(".") for name in self._names]
        self._slots = [(owners[path]._parameters, key) for path, _, key in places]

    def __call__(self, flat: th.Tensor, *args: Any) -> Any:
        """
        Call the network with these parameters instead of its own, which it has again afterwards.

        :param flat: shape (n_parameters,)
        :param args: inputs of the network
        :return: its outputs
        """
        # One split, not one slice per tensor: the gradient of the split is a single concatenation.
        pieces = flat.split(self._sizes)
        tensors = [piece.view(shape) for piece, shape in zip(pieces, self._shapes, strict=True)]
        if th.compiler.is_compiling():
            return functional_call(self._wrapper, dict(zip(self._names, tensors, strict=True)), args)
        return self._call_with(tensors, args)

    def _call_with(self, tensors: list[th.Tensor], args: tuple[Any, ...]) -> Any:
        """What ``functional_call`` does, without its search for names: that search takes longer than a small network."""
        originals = [parameters[key] for parameters, key in self._slots]
        try:
            for (parameters, key), tensor in zip(self._slots, tensors, strict=True):
                parameters[key] = tensor
            return self._wrapper(*args)
        finally:
            for (parameters, key), original in zip(self._slots, originals, strict=True):
                parameters[key] = original


class Storage:
    """
    Flat storage of some parameters and of their optimizer, aliased by the originals.

    :param parameters: parameters in the order of the flat vector
    :param optimizer: their optimizer; ``None`` for target networks, which have no moments
    """

    def __init__(self, parameters: list[th.Tensor], optimizer: th.optim.Optimizer | None = None) -> None:
        self._parameters = parameters
        self._optimizer = optimizer
        self._frozen = [not p.requires_grad for p in parameters]
        self.settings = None if optimizer is None else AdamSettings.of(optimizer, self._trained())
        self._bind()

    @classmethod
    def of(cls, module: nn.Module) -> Storage:
        """
        Storage of all parameters of a network, in the order of ``module.parameters()``.

        :param module: network; its ``optimizer`` attribute, if it has one, is taken over
        :return: the storage, of which the module's tensors are views from now on
        """
        optimizer = getattr(module, "optimizer", None)
        assert optimizer is None or isinstance(optimizer, th.optim.Optimizer)
        return cls(list(module.parameters()), optimizer)

    def _trained(self) -> th.Tensor | None:
        if not any(self._frozen):
            return None
        return _flatten([th.full(p.shape, p.requires_grad, device=p.device) for p in self._parameters])

    def _bind(self) -> None:
        self.params = _flatten([p.detach() for p in self._parameters])
        self._pointers = []
        self._moment_pointers: list[int] = []
        for parameter, view in self._views(self.params):
            parameter.data = view
            self._pointers.append(view.data_ptr())
        if self._optimizer is None:
            return
        saved = [self._optimizer.state.get(p, {}) for p in self._parameters]
        zeros = [th.zeros_like(p) for p in self._parameters]
        self.exp_avg = _flatten([s.get("exp_avg", z) for s, z in zip(saved, zeros, strict=True)])
        self.exp_avg_sq = _flatten([s.get("exp_avg_sq", z) for s, z in zip(saved, zeros, strict=True)])
        steps = {float(s.get("step", 0.0)) for s in saved}
        self.step = th.tensor(max(steps), dtype=th.float32, device=self.params.device)
        for (parameter, first), (_, second) in zip(self._views(self.exp_avg), self._views(self.exp_avg_sq), strict=True):
            self._optimizer.state[parameter] = {"step": self.step, "exp_avg": first, "exp_avg_sq": second}
            self._moment_pointers.append(first.data_ptr())

    def _views(self, flat: th.Tensor) -> list[tuple[th.Tensor, th.Tensor]]:
        pieces = flat.split([p.numel() for p in self._parameters])
        return [(p, piece.view(p.shape)) for p, piece in zip(self._parameters, pieces, strict=True)]

    def is_bound(self) -> bool:
        """
        Whether what an update writes here still reaches the module and its optimizer.

        :return: False once parameters or moments are no views of this storage any more (``load_state_dict`` of an optimizer,
            ``module.to(...)`` and Stable-Baselines3's ``load`` put other tensors in their place), or once other parameters
            of a trained network are frozen (``requires_grad``) than at the start
        """
        # asked before every update of ``learn``, so by addresses that are known instead of by views made anew
        if any(p.data_ptr() != address for p, address in zip(self._parameters, self._pointers, strict=True)):
            return False
        if self._optimizer is None:
            return True
        if any(p.requires_grad is frozen for p, frozen in zip(self._parameters, self._frozen, strict=True)):
            return False
        state = self._optimizer.state
        return all(
            p in state and state[p]["exp_avg"].data_ptr() == address and state[p]["step"] is self.step
            for p, address in zip(self._parameters, self._moment_pointers, strict=True)
        )

    def holds(self, tensor: th.Tensor) -> bool:
        """
        Whether a parameter or buffer is one of those stored here.

        :param tensor: the module's own
        """
        return any(tensor is each for each in self._parameters)

    def move_settings(self, device: th.device) -> None:
        """
        Move the mask of the trained parameters, which only a partly frozen network has, to where the update needs it.

        :param device: where the update runs, if it is not where the parameters lie
        """
        if self.settings is not None and self.settings.trained is not None:
            self.settings = replace(self.settings, trained=self.settings.trained.to(device))

    def set_learning_rate(self, learning_rate: float) -> None:
        """
        Keep the rate in the optimizer, as Stable-Baselines3 does, for what is saved and shown; the update does not read it.

        :param learning_rate: value that the update gets as a tensor; a storage without an optimizer ignores it
        """
        if self._optimizer is not None:
            update_learning_rate(self._optimizer, learning_rate)

    def read(self) -> Learner | th.Tensor:
        """
        The stored vectors as the update takes them: the storage's own, not copies.

        :return: a learner, or the bare flat vector of a target network
        """
        if self._optimizer is None:
            return self.params
        return Learner(self.params, self.exp_avg, self.exp_avg_sq, self.step)

    def write(self, new: Learner | th.Tensor) -> None:
        """
        Copy new values into the storage, and so into the modules.

        :param new: as returned by :meth:`read`
        """
        if isinstance(new, Learner):
            self.exp_avg.copy_(new.exp_avg)
            self.exp_avg_sq.copy_(new.exp_avg_sq)
            self.step.copy_(new.step)
            new = new.params
        self.params.copy_(new)


def _flatten(tensors: list[th.Tensor]) -> th.Tensor:
    return th.cat([t.reshape(-1) for t in tensors]).clone()


class LearnedNumber(NamedTuple):
    """
    A single number trained beside the networks, with an optimizer of its own, such as the log of the entropy coefficient.

    :param optimizer: attribute of its optimizer
    :param start: first value, shape (1,); ``None`` if the parameters say that it is not learned
    :param learning_rate: of the optimizer, at the start
    """

    optimizer: str
    start: th.Tensor | None
    learning_rate: float


class TrainState:
    """
    State tree of one model: a name for each network's storage.

    :param storages: learners and targets by name
    """

    def __init__(self, storages: dict[str, Storage]) -> None:
        self.storages = storages

    def is_bound(self) -> bool:
        """Whether every storage is still the one behind the modules; if not, a new state has to be made of them."""
        return all(storage.is_bound() for storage in self.storages.values())

    def read(self) -> dict[str, Any]:
        """The tree that the update takes: by name a learner, or the flat vector of what has no optimizer."""
        return {name: storage.read() for name, storage in self.storages.items()}
