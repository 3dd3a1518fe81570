"""
Many models trained in one batched computation, which is what a GPU is good at: the update of one model, under ``vmap``.

Every parameter, moment and coefficient gets a leading model dimension; the losses average over the last two dimensions, so
nothing is ever reduced over models. Between any two calls of :meth:`Population.train` each member can be committed to its
ordinary model, which saves, loads and predicts as if it had been trained alone. On a processor nothing is gained: there
seeds are processes (:mod:`sb3_dce.launch`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.utils._pytree import tree_leaves, tree_map

from sb3_dce.base import OfflineAlgorithm
from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.checks import check_steps
from sb3_dce.errors import ConfigError
from sb3_dce.execution import Engine, choose_execution
from sb3_dce.networks import StandardizedExtractor
from sb3_dce.noise import NoiseSpec
from sb3_dce.optimizers import Learner
from sb3_dce.precision import denormals_as_zero, matmul_precision
from sb3_dce.processes import UninterruptedBlock
from sb3_dce.state import Storage

# Parameters of the base class in which members may differ: they reach the update as numbers, or choose the data.
SCALARS = frozenset(
    {
        *("seed", "dataset", "device", "verbose", "tensorboard_log", "stats_window_size", "gradient_steps", "execution"),
        *("learning_rate", "tau", "gamma", "d4rl_compat", "reward_normalization", "reward_scale", "reward_shift"),
    }
)


class StackedState:
    """
    The state tree of all members, each tensor with a leading model dimension.

    :param storages: storages of each member by name
    :param device: where the stacked tensors lie
    """

    def __init__(self, storages: Sequence[dict[str, Storage]], device: th.device) -> None:
        trees = [{name: storage.read() for name, storage in member.items()} for member in storages]
        self._tree = tree_map(lambda *leaves: th.stack(leaves).to(device), *trees)

    def read(self) -> dict[str, Any]:
        """Name to learner or flat vectors of all members: the tensors themselves, which an update overwrites."""
        return self._tree

    def member(self, index: int) -> dict[str, Learner | th.Tensor]:
        """
        The state tree of one member, without the model dimension: views of the stacked tensors.

        :param index: number of the member
        """
        return tree_map(lambda leaf: leaf[index], self._tree)


class Population:
    """
    Models of one shape, trained together.

    :param models: ordinary models, on the CPU, with the same number of completed updates. They may differ in dataset, seed
        and every parameter of :data:`SCALARS` or of their class's ``population_scalars``
    :param device: where the training happens
    :param execution: as in :class:`~sb3_dce.base.OfflineAlgorithm`
    :param own_randomness: let each member draw what it would draw alone, so that it becomes the same model; without it all
        draw at once, which takes fewer launches
    :param seed: of the common draws
    :raises ConfigError: if the models cannot be trained together; the message names the parameter
    """

    def __init__(
        self,
        models: Sequence[OfflineAlgorithm],
        device: th.device | str = "cpu",
        execution: str = "auto",
        own_randomness: bool = False,
        seed: int = 0,
    ) -> None:
        check_alike(models)
        self.models = list(models)
        self.device = th.device(device)
        self.own_randomness = own_randomness
        self._execution = execution
        share_data(self.models)
        self._n_updates = self.models[0]._n_updates
        self._storages = [model.make_storages() for model in self.models]
        self.state = StackedState(self._storages, self.device)
        self._dtype = next(self.models[0].policy.parameters()).dtype
        self._rows, self._offsets, self._lengths = _joined_rows(self.models, self.device)
        self._shift, self._scale = _standardization(self.models, self.device)
        self._generator = th.Generator(device=self.device)
        self._generator.manual_seed(seed)
        self._coef: dict[str, th.Tensor] = {}
        self._coef_values: dict[str, list[float]] = {}
        self._coef_hold_until = 0
        self._engine: Engine[StackedState] | None = None
        self.is_whole = True  # False during an update, and after one that was interrupted, as by a second Ctrl-C

    def __len__(self) -> int:
        return len(self.models)

    @property
    def n_updates(self) -> int:
        """Completed updates, the same number for each member; those made before the members were put together count."""
        return self._n_updates

    # -- training --------------------------------------------------------------------------------------------------

    def train(self, n_updates: int, total_updates: int | None = None) -> None:
        """
        Train all members. When this returns or is interrupted, ``models`` hold what was learned, ready to predict and to be
        saved.

        :param n_updates: updates of each
        :param total_updates: updates of the whole run, over which learning rates may fall, and which decide whether
            compiling pays; default: those completed and these
        :raises ConfigError: if ``n_updates`` is no whole number from 0 up, or a member was trained or loaded by itself since
        """
        n_updates, first, before = check_steps("n_updates", n_updates), self.models[0], self._n_updates
        self._refuse_replaced()
        total = self._n_updates + n_updates if total_updates is None else total_updates
        for model in self.models:
            model.policy.set_training_mode(True)
        engine = self._bound_engine(total)
        specs = first.noise_specs(first.batch_size)

        def draw() -> tuple[dict[str, th.Tensor], dict[str, th.Tensor]]:
            indices, noise = self._draw(specs, first.batch_size)
            return self._gather(indices), noise

        # what each member draws for itself comes from its model, on the processor
        on_device = None if self.own_randomness else self._generator
        source = (first.batch_size, first.precision, tuple(specs.items()))
        try:
            with denormals_as_zero(), matmul_precision(first.precision, self.device):
                for _ in range(n_updates):
                    variant = first.update_variant(self._n_updates)
                    with UninterruptedBlock() if engine.has_run(variant) else nullcontext():
                        self.is_whole = False
                        engine.step_drawn(draw, self._coefficients(total), on_device, None, source, **variant)
                        self._n_updates += 1
                        self.is_whole = True
                        if first.reads_state_after(self._n_updates):
                            for index, model in enumerate(self.models):
                                model._n_updates = self._n_updates
                                model.read_state(self.state.member(index))
        finally:
            with UninterruptedBlock():  # else some members would be of this moment and others of an earlier one
                for model in self.models:
                    model._n_updates = self._n_updates
                    model.num_timesteps += self._n_updates - before
                self.commit()

    def _refuse_replaced(self) -> None:
        """What was written into other tensors would be lost."""
        for index, (model, storages) in enumerate(zip(self.models, self._storages, strict=True)):
            if model._n_updates != self._n_updates or not all(storage.is_bound() for storage in storages.values()):
                raise ConfigError(
                    f"member {index} was trained, loaded or moved by itself, so it is no part of this population any more",
                    key="models",
                    hint="Make a new Population of the models; it goes on from what they are.",
                )

    def _bound_engine(self, planned_updates: int) -> Engine[StackedState]:
        if self._engine is None:
            template = _template(self.models[0], self.device)
            for storage in self._storages[0].values():
                storage.move_settings(self.device)
            update = template.make_update(self._storages[0])

            def together(state: Any, batch: Any, noise: Any, coef: Any, **variant: Any) -> Any:
                def one(state: Any, batch: Any, noise: Any, coef: Any) -> Any:
                    return update(state, ReplayBufferSamples(**batch), noise, coef, **variant)

                return th.vmap(one)(state, batch, noise, coef)

            execution = choose_execution(self._execution, planned_updates, self.device)
            self._engine = Engine(together, self.state, execution)
        return self._engine

    def _draw(self, specs: dict[str, NoiseSpec], batch_size: int) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """Row numbers, shape (models, batch), and noise with a leading model dimension."""
        if not self.own_randomness:
            # The bias of the remainder is below 1e-11.
            numbers = th.randint(2**62, (len(self), batch_size), generator=self._generator, device=self.device)
            several = {name: replace(spec, shape=(len(self), *spec.shape)) for name, spec in specs.items()}
            noise = {name: spec.draw(self._generator, self.device, self._dtype) for name, spec in several.items()}
            return numbers % self._lengths[:, None], noise
        indices, noises = [], []
        for model in self.models:  # in the order of OfflineAlgorithm.train
            generator = model._training_generator()
            indices.append(model.draw_rows(generator, batch_size))
            noises.append({name: spec.draw(generator, model.device, self._dtype) for name, spec in specs.items()})
        stacked = tree_map(lambda *draws: th.stack(draws).to(self.device), *noises) if specs else {}
        return th.stack(indices).to(self.device), stacked

    def _gather(self, indices: th.Tensor) -> dict[str, th.Tensor]:
        buffer = self.models[0].replay_buffer
        assert isinstance(buffer, OfflineReplayBuffer)
        flat = (indices + self._offsets[:, None]).reshape(-1)
        rows = self._rows.index_select(0, flat).view(*indices.shape, -1).to(self._dtype)
        fields = {name: value for name, value in buffer.split_rows(rows)._asdict().items() if value is not None}
        if self._shift is not None:
            for name in ("observations", "next_observations"):
                fields[name] = (fields[name] - self._shift[:, None]) / self._scale[:, None]
        return fields

    def _coefficients(self, total: int) -> dict[str, th.Tensor]:
        """Coefficients of all members, each of shape (models,), in the same tensors at every update."""
        if self._n_updates < self._coef_hold_until:
            return self._coef
        for model in self.models:
            model._update_current_progress_remaining(self._n_updates, total)
        members = [model.coefficients(self._n_updates) for model in self.models]
        for name in members[0]:
            values = [member[name] for member in members]
            if self._coef_values.get(name) == values:
                continue  # a copy to a GPU waits for all that it has to do
            tensor = th.tensor(values, dtype=self._dtype, device=self.device)
            if name in self._coef:
                self._coef[name].copy_(tensor)  # in place: a compiled or captured step reads this very tensor
            else:
                self._coef[name] = tensor
            self._coef_values[name] = values
        self._coef_hold_until = min(model.coefficients_hold_until(self._n_updates) for model in self.models)
        return self._coef

    # -- members as ordinary models --------------------------------------------------------------------------------

    def commit(self) -> list[OfflineAlgorithm]:
        """
        Write the members' parameters and moments into their models, as :meth:`train` does at its end.

        :return: the models, ready to predict and to be saved
        """
        for index, (model, storages) in enumerate(zip(self.models, self._storages, strict=True)):
            rates = model.learning_rates()
            for name, value in self.state.member(index).items():
                storages[name].write(value)
                storages[name].set_learning_rate(rates.get(f"{name}_learning_rate", rates["learning_rate"]))
        return self.models

    def read_metrics(self) -> list[dict[str, float]]:
        """
        Mean of every diagnostic since the last call, and what the agent derives from these means, member by member.

        :return: name -> value for each member, empty before the first update; NaN and infinity are passed on, since one member
            that diverges is no reason to stop the others
        """
        if self._engine is None:
            return [{} for _ in self.models]
        means = self._engine.metrics.read_members()
        members = [{name: float(values[k]) for name, values in means.items()} for k in range(len(self))]
        return [{**m, **model.derived_metrics(m)} if m else m for m, model in zip(members, self.models, strict=True)]

    def random_state(self) -> th.Tensor:
        """State of the generator of the common draws, which a checkpoint keeps to go on with the same numbers."""
        return self._generator.get_state()

    def set_random_state(self, state: th.Tensor) -> None:
        """
        Go on with the common draws of an interrupted population.

        :param state: as returned by :meth:`random_state`, on the same kind of device
        """
        self._generator.set_state(state)

    def memory(self) -> dict[str, int]:
        """Bytes on the device: ``data``, rows that members may share, and ``networks``, the state of all members."""
        state = sum(leaf.numel() * leaf.element_size() for leaf in tree_leaves(self.state.read()))
        return {"data": self._rows.numel() * self._rows.element_size(), "networks": state}


def free_parameters(cls: type[OfflineAlgorithm]) -> frozenset[str]:
    """
    Parameters in which members of a population may differ: :data:`SCALARS`, and the agent's ``population_scalars``.

    :param cls: agent; those of its bases count, too
    :return: names of constructor arguments
    """
    return SCALARS.union(*(getattr(base, "population_scalars", ()) for base in cls.__mro__))


def check_alike(models: Sequence[OfflineAlgorithm]) -> None:
    """
    Refuse models that differ in more than data, seed and numbers, or stand behind a ``VecNormalize``.

    :param models: candidates for a population
    :raises ConfigError: if they cannot be trained in one batched computation
    """
    if not models:
        raise ConfigError("a population needs at least one model", key="models", hint="Give a specification for each member.")
    if any(model.get_vec_normalize_env() is not None for model in models):
        hint = "Set normalize_obs=True instead, whose statistics stay in each model."
        raise ConfigError("members of a population cannot have a VecNormalize", key="env", hint=hint)
    first = models[0]
    allowed = free_parameters(type(first))
    differing: str
    theirs: Any
    ours: Any
    for index, model in enumerate(models[1:], start=1):
        if type(model) is not type(first):
            differing, theirs, ours = "algorithm", model.algo_name, first.algo_name
        else:
            mine, other = first.hyperparameters(), model.hyperparameters()
            found = [name for name in mine if name not in allowed and mine[name] != other[name]]
            kinds = [[type(module) for module in m.policy.modules()] for m in (first, model)]
            shapes = [[p.shape for p in m.policy.parameters()] for m in (first, model)]
            storages = [m.make_storages() for m in (first, model)]
            names = [set(each) for each in storages]
            frozen = [[n for n, p in m.policy.named_parameters() if not p.requires_grad] for m in (first, model)]
            if found:
                differing, theirs, ours = found[0], other[found[0]], mine[found[0]]
            elif kinds[0] != kinds[1]:  # the update is made from the networks of member 0
                ours, theirs = next(pair for pair in zip_longest(*kinds) if pair[0] is not pair[1])
                differing = "policy"
            elif shapes[0] != shapes[1]:
                differing, theirs, ours = "network shapes", model.observation_space, first.observation_space
            elif (buffer := _differing_buffer(first, model, storages[0])) is not None:
                differing, ours, theirs = buffer
            elif frozen[0] != frozen[1]:
                differing, theirs, ours = "frozen parameters", frozen[1], frozen[0]
            elif names[0] != names[1]:
                differing, theirs, ours = "learners", sorted(names[1]), sorted(names[0])
            elif model._n_updates != first._n_updates:
                differing, theirs, ours = "completed updates", model._n_updates, first._n_updates
            else:
                continue
        raise ConfigError(
            f"member {index} cannot be trained together with member 0: {differing} is {theirs!r}, not {ours!r}",
            key=differing,
            hint="Members may differ in data, seed and numbers such as beta; train the others as a population of their own.",
        )


def _differing_buffer(
    first: OfflineAlgorithm, other: OfflineAlgorithm, storages: dict[str, Storage]
) -> tuple[str, Any, Any] | None:
    """
    A buffer that is not the same in both, with its shapes or its first differing numbers. Statistics of observations may
    differ, since each member's are applied to it, and what the update changes, which is in the first one's storages.
    """
    for path, module in first.policy.named_modules():
        for name, mine in module.named_buffers(path, recurse=False):
            its = other.policy.get_buffer(name)
            if isinstance(module, StandardizedExtractor) or any(storage.holds(mine) for storage in storages.values()):
                continue
            if mine.shape != its.shape:
                return f"shape of buffer {name}", tuple(mine.shape), tuple(its.shape)
            if (unequal := mine != its).any():
                return f"buffer {name}", mine[unequal][0].item(), its[unequal][0].item()
    return None


def share_data(models: Sequence[OfflineAlgorithm]) -> None:
    """
    Attach every model's dataset, reading each only once.

    :param models: models on the CPU
    """
    read: dict[Any, Any] = {}
    for model in models:
        space: Any = model.action_space
        key = (model.dataset, model.d4rl_compat, space.low.tobytes(), space.high.tobytes())
        if model.dataset is not None and model.replay_buffer is not None and model.replay_buffer.size() == 0:
            if key in read:
                model._transitions = read[key]
            else:
                read[key] = model._load_transitions()
        model.attach_dataset()


def _joined_rows(models: Sequence[OfflineAlgorithm], device: th.device) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """One matrix of all different data, and for each model its first row and number of rows."""
    parts: dict[int, tuple[int, th.Tensor]] = {}
    total, offsets, lengths = 0, [], []
    for model in models:
        buffer = model.replay_buffer
        assert isinstance(buffer, OfflineReplayBuffer) and buffer.rows is not None
        rows = buffer.rows[: buffer.size()]
        if rows.data_ptr() not in parts:
            parts[rows.data_ptr()] = (total, rows)
            total += len(rows)
        offsets.append(parts[rows.data_ptr()][0])
        lengths.append(len(rows))
    matrices = [rows for _, rows in parts.values()]
    joined = matrices[0] if len(matrices) == 1 else th.cat(matrices)
    return joined.to(device), th.tensor(offsets, device=device), th.tensor(lengths, device=device)


def _standardization(models: Sequence[OfflineAlgorithm], device: th.device) -> tuple[th.Tensor | None, th.Tensor]:
    """Mean and divisor of each member's observations, shape (models, obs_dim); ``None`` where nothing is standardised."""
    if not models[0].normalize_obs:
        return None, th.ones(1)
    extractors = [next(m for m in model.policy.modules() if isinstance(m, StandardizedExtractor)) for model in models]
    mean = th.stack([extractor.mean for extractor in extractors])
    return mean.to(device), th.stack([extractor.std + extractor.eps for extractor in extractors]).to(device)


def _template(model: OfflineAlgorithm, device: th.device) -> OfflineAlgorithm:
    """The model whose networks state the update: a copy, with observations that are standardised already left alone."""
    template = copy.copy(model)
    template.policy = copy.deepcopy(model.policy).to(device)  # what is no parameter is read from the networks
    for name in model.networks:
        setattr(template, name, getattr(template.policy, name))
    for module in template.policy.modules():
        if isinstance(module, StandardizedExtractor):
            module.eps = 0.0
            module.set_statistics(th.zeros_like(module.mean), th.ones_like(module.std))
    return template
