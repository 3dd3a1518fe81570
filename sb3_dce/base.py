"""
The base class of all offline agents: a Stable-Baselines3 algorithm that learns from a dataset and steps no environment.

One timestep of ``learn()`` is one gradient step and one call of ``callback.on_step()``, so that every frequency of every
callback keeps its meaning and an evaluation at step N sees exactly N updates.
"""

from __future__ import annotations

import os
import time
import warnings
from contextlib import nullcontext
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_dce.attaching import DatasetLike
from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.checks import check_choice, check_number, check_optional, check_seed, check_steps
from sb3_dce.diagnostics import RECORDED, DiagnosticsMixin
from sb3_dce.divergence import Rewind, locate
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import ConfigError, DivergenceError, SB3DCEWarning
from sb3_dce.execution import EXECUTIONS, Engine, Update, choose_execution
from sb3_dce.hyperparams import constructor_parameters
from sb3_dce.networks import StandardizedExtractor
from sb3_dce.noise import NoiseSpec
from sb3_dce.precision import PRECISIONS, denormals_as_zero, matmul_precision
from sb3_dce.processes import UninterruptedBlock
from sb3_dce.saving import SavingMixin
from sb3_dce.sb3_checks import (
    callback_frequencies,
    check_device,
    check_flags,
    check_logging,
    check_one_env,
    check_spaces,
    named_env,
    nested_callbacks,
    policy_arguments,
    python_number,
)
from sb3_dce.state import LearnedNumber, Storage, TrainState

SelfOffline = TypeVar("SelfOffline", bound="OfflineAlgorithm")

# Metrics are read back at least this often (updates), so that a divergence is noticed even without logging, and that as few
# updates are made again to find where it began.
GUARD_INTERVAL = 100


class OfflineAlgorithm(DiagnosticsMixin, SavingMixin):
    """
    Base of the offline agents. A subclass states its update and its networks; everything else is here, once.

    :param policy: ``"MlpPolicy"`` or a policy class
    :param env: environment for evaluation, an id, or ``None``: then a dataset gives the spaces. It is never stepped for
        training
    :param dataset: catalogue id ("walker2d-medium"), ``minari:`` and an id of Minari, path of a file (HDF5 in D4RL's layout,
        NPZ, CSV, Parquet), or ``Transitions``; :func:`sb3_dce.load_dataset` makes these of everything else. Read at the first
        ``learn()``; only its id or path is saved with the model
    :param learning_rate: Adam's learning rate for all networks, or a schedule of the remaining progress
    :param batch_size: rows per gradient step, drawn uniformly with replacement
    :param tau: Polyak coefficient of the targets (the paper's upsilon)
    :param gamma: discount factor in [0, 1]
    :param gradient_steps: gradient steps per call of ``train()``; the callbacks' frequencies must be multiples of it
    :param max_grad_norm: clip the gradient of each network, all critics together, to this norm; ``None`` is off
    :param d4rl_compat: use exactly the rows of D4RL's ``qlearning_dataset``
    :param normalize_obs: standardise observations with the dataset's mean and deviation, kept in the saved networks
    :param reward_normalization: ``"iql"`` multiplies rewards by 1000 / (largest - smallest episode return)
    :param reward_scale: factor on every reward
    :param reward_shift: added to every reward after scaling, reward units
    :param execution: ``"eager"``, ``"compile"`` (one compiled graph), ``"cudagraph"`` (that graph captured, on a CUDA
        device), or ``"auto"``: eager up to 10,000 planned updates, beyond that captured on a CUDA device and, where a C++
        compiler and Python's headers are there, compiled on a CPU
    :param precision: of matrix products: ``"float32"``, ``"bf16-matmul"`` on processors that have it, ``"tf32"`` on a CUDA
        device. Parameters stay float32; the switch is put back after training
    :param stats_window_size: kept for Stable-Baselines3's logger
    :param tensorboard_log: folder of TensorBoard logs
    :param policy_kwargs: arguments of the policy, such as ``net_arch`` or ``n_critics``
    :param verbose: 0 quiet, 1 information, 2 debugging
    :param seed: fixes networks, batches and noise
    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``
    :param needs_env: refuse a missing environment without a dataset (False while a saved model is loaded)
    :raises ConfigError: for a wrong parameter or combination
    """

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None,
        dataset: DatasetLike | None,
        learning_rate: float | Schedule,
        *,
        batch_size: int,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int,
        max_grad_norm: float | None = None,
        d4rl_compat: bool,
        normalize_obs: bool,
        reward_normalization: str | None = None,
        reward_scale: float = 1.0,
        reward_shift: float = 0.0,
        execution: str,
        precision: str = "float32",
        stats_window_size: int,
        tensorboard_log: str | None,
        policy_kwargs: dict[str, Any] | None,
        verbose: int,
        seed: int | None,
        device: th.device | str,
        needs_env: bool,
    ) -> None:
        seed = check_seed(seed)
        check_device(device)
        check_logging(verbose, stats_window_size, tensorboard_log)
        self.d4rl_compat = d4rl_compat
        spec = self._remember_dataset(dataset)
        if env is None and needs_env:
            env = self._spaces_env(spec, verbose)
        if env is not None:
            env = named_env(env, verbose)
            if isinstance(env, VecEnv):
                check_one_env(env)
            if isinstance(env, (gym.Env, VecEnv)):  # Stable-Baselines3 says what else it takes
                check_spaces(env.observation_space, env.action_space)
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate,
            learning_starts=0,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=(1, "step"),
            gradient_steps=gradient_steps,
            replay_buffer_class=OfflineReplayBuffer,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
        )
        self.algo = self.algo_name  # tells whose file a saved model is
        self.max_grad_norm = max_grad_norm
        self.normalize_obs = normalize_obs
        self.reward_normalization = reward_normalization
        self.reward_scale = reward_scale
        self.reward_shift = reward_shift
        self.execution = execution
        self.precision = precision
        self.dataset_statistics, self.trained_return_range = None, None
        self._engine: Engine[TrainState] | None = None
        self._generator: th.Generator | None = None
        self._coef: dict[str, th.Tensor] = {}
        self._coef_values: dict[str, float] = {}  # what the tensors hold
        self._warned_large_q = False
        self._rewind = None
        self._new_run = True
        self._metrics_read_at = (time.time_ns(), 0)
        self.stats_window_size = stats_window_size

    # -- to be stated by a subclass --------------------------------------------------------------------------------

    # Networks of the policy by attribute name. Each becomes an attribute of the agent and a storage of the update; those
    # with an ``optimizer`` are trained, the others are targets or frozen.
    networks: ClassVar[tuple[str, ...]]
    # Length of the run that these updates belong to, where it is known: what is resumed is executed as it was begun.
    planned_updates: int | None = None
    # Attributes that :meth:`read_state` changes.
    adapted_parameters: ClassVar[tuple[str, ...]] = ()
    # Parameters of the subclass in which the members of a population may differ, since they reach the update as numbers.
    population_scalars: ClassVar[frozenset[str]] = frozenset()

    def make_update(self, storages: dict[str, Storage]) -> Update:
        """
        The gradient step as a function, with networks and trace-time choices bound; made once for each engine.

        :param storages: as returned by :meth:`make_storages`
        :return: pure update ``(state, batch, noise, coef, **variant) -> (new state, metrics)``
        """
        raise NotImplementedError

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        """
        Kind and shape of the random numbers that are drawn anew for every update.

        :param batch_size: rows per gradient step
        :return: specifications by the name that the update reads them by, in the order of the draws
        """
        raise NotImplementedError

    def learned_numbers(self) -> dict[str, LearnedNumber]:
        """
        Numbers learned beside the networks, such as the temperature, each with an optimizer of its own; here none.

        :return: by the attribute of their tensor. Each becomes a storage of the update and a part of the saved model
        """
        return {}

    def update_variant(self, n_updates: int) -> dict[str, Any]:
        """
        Keywords of the next update, such as ``with_actor``; each combination is compiled or captured by itself.

        :param n_updates: completed updates
        :return: choices that are fixed when the update is traced; here none
        """
        return {}

    def learning_rates(self) -> dict[str, float]:
        """
        Rates at the present point of the schedule; they go into the coefficients and into the optimizers that are saved.

        :return: learning rate of the next update by coefficient: ``learning_rate``, and ``<network>_learning_rate`` for
            a network that has its own
        """
        return {"learning_rate": self.lr_schedule(self._current_progress_remaining)}

    def coefficients(self, n_updates: int) -> dict[str, float]:
        """
        Numbers that reach the update as 0-dimensional tensors, so that it need not be traced again when they change.

        :param n_updates: completed updates
        :return: numbers of the next update by name
        """
        return {
            **self.learning_rates(),
            "tau": self.tau,
            "gamma": self.gamma,
            "reward_scale": self._reward_factor(),
            "reward_shift": self.reward_shift,
        }

    def coefficients_hold_until(self, n_updates: int) -> int:
        """
        Spares a population from asking every member before each update; here nothing is promised beyond the next one.

        :param n_updates: completed updates
        :return: completed updates before which :meth:`coefficients` gives the same numbers again
        """
        return n_updates + 1

    def reads_state_after(self, n_updates: int) -> bool:
        """
        Whether :meth:`read_state` is to be called now, asked after every update.

        :param n_updates: completed updates
        :return: False here. Reading waits for the device: let it be rare
        """
        return False

    def read_state(self, state: dict[str, Any]) -> None:
        """
        Adapt a parameter to what the updates have found.

        :param state: state tree of the model on the device
        """

    def policy_settings(self) -> dict[str, Any]:
        """
        Arguments of the policy that follow from the agent's own parameters; ``policy_kwargs`` is merged into them.

        :return: arguments by name; here the features extractor that standardises, if ``normalize_obs`` is set
        """
        return {"features_extractor_class": StandardizedExtractor} if self.normalize_obs else {}

    def check_parameters(self) -> None:
        """
        Runs before networks are made, for a new model and for a loaded one; a subclass adds its own parameters.

        :raises ConfigError: if a parameter is out of its range
        """
        check_flags(self)
        check_number("batch_size", self.batch_size, 1, integer=True)
        check_number("gradient_steps", self.gradient_steps, 1, integer=True)
        check_optional("max_grad_norm", self.max_grad_norm, 0, open_low=True)
        check_number("tau", self.tau, 0, 1, hint="Usual is 0.005. The paper's tau is the expectile.")
        check_number("gamma", self.gamma, 0, 1)
        check_number("reward_scale", self.reward_scale, 0, open_low=True)
        check_number("reward_shift", self.reward_shift, -float("inf"), open_low=True)
        check_choice("execution", self.execution, EXECUTIONS)
        check_choice("precision", self.precision, PRECISIONS)
        check_choice("reward_normalization", self.reward_normalization, (None, "iql"))
        if not callable(self.learning_rate):
            check_number("learning_rate", self.learning_rate, 0, hint="The paper uses 3e-4.")

    # -- construction ----------------------------------------------------------------------------------------------

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ConfigError(
                f"policy {policy_name!r} is not offered: allowed are {sorted(self.policy_aliases)}",
                key="policy",
                hint="Offline data of this package are vectors: use 'MlpPolicy', or pass a policy class.",
            )
        return self.policy_aliases[policy_name]

    def _setup_model(self) -> None:
        self.check_parameters()
        self._stats_window_size = self.stats_window_size
        self.learning_rate = python_number(self.learning_rate)
        given, settings = self.policy_kwargs, self.policy_settings()
        self.policy_kwargs = policy_arguments(given, self.policy_class, settings)
        try:
            super()._setup_model()
        finally:
            # The user's own arguments are what is saved and compared at load time.
            self.policy_kwargs = given
        for name in self.networks:
            if not hasattr(self.policy, name):
                ours = self.policy_aliases["MlpPolicy"].__name__
                what = f"{type(self.policy).__name__} has no {name!r}, which {type(self).__name__} trains"
                raise ConfigError(what, key="policy", hint=f"Use 'MlpPolicy', or derive the policy from sb3_dce's {ours}.")
            setattr(self, name, getattr(self.policy, name))
        self.setup_extras()
        self._engine = None
        self._coef = {}

    def setup_extras(self) -> None:
        """Create what the networks do not hold: numbers that are learned, each with its optimizer."""
        for name, number in self.learned_numbers().items():
            tensor = None if number.start is None else number.start.to(self.device).requires_grad_(True)
            setattr(self, name, tensor)
            optimizer = None if tensor is None else th.optim.Adam([tensor], lr=number.learning_rate)
            setattr(self, number.optimizer, optimizer)

    def set_random_seed(self, seed: int | None = None) -> None:
        seed = check_seed(seed)
        super().set_random_seed(seed)
        self._seed_generator(seed)

    def _seed_generator(self, seed: int | None) -> None:
        """All randomness of training comes from this one generator; its state is saved, so a loaded model goes on."""
        generator = th.Generator(device=self.device)
        generator.manual_seed(int.from_bytes(os.urandom(4), "little") if seed is None else seed)
        self._generator = None
        self.rng_state = generator.get_state()

    def _training_generator(self) -> th.Generator:
        if self._generator is None:
            self._generator = th.Generator(device=self.device)
            try:
                self._generator.set_state(self.rng_state.cpu())  # loading a model puts it on the model's device
            except RuntimeError:  # saved on another kind of device, which has another kind of state
                entropy = None if self.seed is None else (self.seed, self._n_updates)  # not the numbers of the beginning
                self._generator.manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))
                text = f"the model was saved on another kind of device: on {self.device.type} other random numbers follow"
                warnings.warn(text, SB3DCEWarning)
        return self._generator

    def hyperparameters(self) -> dict[str, Any]:
        """
        Constructor arguments in force, as ``config.yml`` records them and as members of a population are compared.

        :return: values by name; policy, environment and internal ones left out
        """
        names = [n for n in constructor_parameters(type(self)) if n not in ("policy", "env", "_init_setup_model")]
        return {name: getattr(self, name) for name in names if hasattr(self, name)}

    def make_storages(self) -> dict[str, Storage]:
        """
        Move all parameters and moments into flat vectors, of which the modules' own tensors are views from then on.

        :return: storage of each network, and of further learners, by name; what is ``None`` has none
        """
        modules = {name: getattr(self, name) for name in self.networks}
        storages = {name: Storage.of(module) for name, module in modules.items() if module is not None}
        for name, number in self.learned_numbers().items():
            if (tensor := getattr(self, name)) is not None:
                storages[name] = Storage([tensor], getattr(self, number.optimizer))
        return storages

    def _excluded_save_params(self) -> list[str]:
        numbers = self.learned_numbers()
        optimizers = [number.optimizer for number in numbers.values()]
        return [*super()._excluded_save_params(), *self.networks, *numbers, *optimizers]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        modules, tensors = super()._get_torch_save_params()
        trained = [name for name in self.networks if hasattr(getattr(self, name), "optimizer")]
        # by the parameters: a temperature fixed since the model was made is saved as one
        numbers = {name: number.optimizer for name, number in self.learned_numbers().items() if number.start is not None}
        return [*modules, *(f"{name}.optimizer" for name in trained), *numbers.values()], [*tensors, *numbers]

    # -- training --------------------------------------------------------------------------------------------------

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """
        Run gradient steps on batches of the dataset. Nothing is read back from the device.

        :param gradient_steps: number of steps
        :param batch_size: rows per step
        """
        self.attach_dataset()
        buffer = self._own_buffer()
        self.policy.set_training_mode(True)  # evaluation leaves the policy in evaluation mode
        planned = max(self._total_timesteps - self.num_timesteps, gradient_steps)
        engine = self._bound_engine(self.planned_updates or planned)
        generator, specs = self._training_generator(), self.noise_specs(batch_size)
        dtype = next(self.policy.parameters()).dtype
        rates = self.learning_rates()
        for name, storage in engine.state.storages.items():
            storage.set_learning_rate(rates.get(f"{name}_learning_rate", rates["learning_rate"]))
        known = self._rewind
        if known is None or known.engine is not engine or known.batch_size != batch_size:
            self._rewind = Rewind.of(self, engine, batch_size)
        assert buffer.rows is not None
        rows = (buffer.rows.data_ptr(), buffer.size())
        source = (batch_size, self.precision, tuple(specs.items()))

        def draw() -> tuple[ReplayBufferSamples, dict[str, th.Tensor]]:
            batch = buffer.gather(self.draw_rows(generator, batch_size), self._vec_normalize_env)
            if dtype != th.float32:
                batch = batch._replace(**{k: v.to(dtype) for k, v in batch._asdict().items() if v is not None})
            return batch, {name: spec.draw(generator, self.device, dtype) for name, spec in specs.items()}

        # statistics of VecNormalize are applied on the processor
        on_device = None if self._vec_normalize_env is not None else generator
        with denormals_as_zero(), matmul_precision(self.precision, self.device):
            for _ in range(gradient_steps):
                variant = self.update_variant(self._n_updates)
                # The networks of an update are written one after the other. The first call may compile for a minute.
                with UninterruptedBlock() if engine.has_run(variant) else nullcontext():
                    coef = self._coefficient_tensors(dtype)
                    engine.step_drawn(draw, coef, on_device, rows, source, **variant)
                    self._n_updates += 1
                    if self.reads_state_after(self._n_updates):
                        self.read_state(engine.state.read())

    def draw_rows(self, generator: th.Generator, batch_size: int) -> th.Tensor:
        """
        Row numbers of the next batch, drawn uniformly with replacement from the filled part of the replay buffer.

        :param generator: what an update draws with; the rows come first
        :param batch_size: rows per step
        :return: shape (batch_size,)
        """
        return th.randint(self._own_buffer().size(), (batch_size,), generator=generator, device=self.device)

    def divergence(self, names: list[str]) -> DivergenceError:
        last = self._n_updates
        error = locate(self, self._rewind, names, self._metrics_read_at[1])
        self._rewind = None
        self.num_timesteps += self._n_updates - last
        return error

    def _bound_engine(self, planned_updates: int) -> Engine[TrainState]:
        """
        The engine, made anew when the modules' tensors were replaced (loading, ``set_parameters``, ``to``), or when a long
        run begins that is worth compiling. What is compiled stays so: the price is paid.
        """
        engine = self._engine if self._engine is not None and self._engine.state.is_bound() else None
        execution = None if engine is None else engine.execution
        if engine is None or (self._new_run and execution == "eager"):
            execution = choose_execution(self.execution, planned_updates, self.device)
        self._new_run = False
        if engine is None or execution != engine.execution:
            storages = self.make_storages()
            assert execution is not None
            if self.verbose >= 1 and execution != "eager":
                print("Preparing the update for a long run, once: up to a minute.", flush=True)
            engine = Engine(self.make_update(storages), TrainState(storages), execution, planned_updates)
            if self._engine is not None:
                engine.metrics = self._engine.metrics
            self._engine = engine
        return engine

    def _coefficient_tensors(self, dtype: th.dtype) -> dict[str, th.Tensor]:
        for name, value in self.coefficients(self._n_updates).items():
            if name not in self._coef or self._coef[name].dtype != dtype:
                self._coef[name] = th.tensor(value, dtype=dtype, device=self.device)
            elif self._coef_values[name] != value:
                # In place: a compiled or captured step reads the tensor, not a number baked in when it was traced.
                self._coef[name].fill_(value)
            self._coef_values[name] = value
        return self._coef

    def learn(
        self: SelfOffline,
        total_timesteps: int | float,
        callback: MaybeCallback = None,
        log_interval: int | None = 1000,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOffline:
        """
        Train on the dataset.

        :param total_timesteps: gradient steps, a whole number; ``1e6`` is accepted
        :param callback: called after every gradient step; where it has a method ``on_training_failed()``, also after an error
        :param log_interval: gradient steps between two log rows; ``None`` logs nothing by itself
        :param tb_log_name: name of the TensorBoard run, default the class name
        :param reset_num_timesteps: start counting timesteps from 0; ``_n_updates``, which drives beta, always goes on
        :param progress_bar: show a progress bar
        :return: the model itself
        :raises ConfigError: without data, or if a callback's frequency is no multiple of ``gradient_steps``
        :raises DivergenceError: if a loss is not finite
        """
        total_timesteps, callback = self._setup_learn(
            check_steps("total_timesteps", total_timesteps),
            callback,
            reset_num_timesteps,
            tb_log_name or type(self).__name__,
            progress_bar,
        )
        self._check_frequencies(callback, log_interval)
        callback.on_training_start(locals(), globals())
        try:
            self._train_until(total_timesteps, callback, log_interval)
        except BaseException:
            for part in nested_callbacks(callback):
                getattr(part, "on_training_failed", lambda: None)()
            raise
        callback.on_training_end()
        return self

    def _train_until(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        keep_going = True
        while keep_going and self.num_timesteps < total_timesteps:
            chunk = min(self._chunk_around(self.num_timesteps)[1], total_timesteps) - self.num_timesteps
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            timesteps, updates = self.num_timesteps, self._n_updates
            try:
                self.train(gradient_steps=chunk, batch_size=self.batch_size)
                keep_going = self._count_steps(chunk, callback, log_interval)
            except BaseException:
                self.num_timesteps = timesteps + self._n_updates - updates  # what is saved now can go on
                raise
        self._refuse_divergence()  # a run may be shorter than the intervals of the log

    def _chunk_around(self, timestep: int) -> tuple[int, int]:
        """
        Begin and end of the chunk of updates that the next one after ``timestep`` is in. It ends where a callback may be due:
        some count timesteps, Stable-Baselines3's the calls of this ``learn()``, which may begin between two multiples.
        """
        g = self.gradient_steps
        done = (timestep % g, (timestep - self._num_timesteps_at_start) % g)
        return timestep - min(done), timestep + g - max(done)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        self.attach_dataset()
        if self.env is None:
            self.set_env(SpacesEnv(self.observation_space, self.action_space))
        self._prepare_vec_normalize()
        self._metrics_read_at = (time.time_ns(), self._n_updates)
        self._rewind = None
        self._new_run = True
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _check_frequencies(self, callback: BaseCallback, log_interval: int | None) -> None:
        if log_interval is not None:
            check_number("log_interval", log_interval, 1, integer=True, hint="It counts gradient steps; None logs nothing.")
        # A log row in the middle of a chunk is harmless: it shows the whole chunk.
        for name, value in callback_frequencies(callback):
            self.check_frequency(name, value)

    def check_frequency(self, name: str, value: int) -> None:
        """
        Refuse a frequency that is no multiple of ``gradient_steps``; 0 and negative ones pass.

        :param name: parameter of a callback that acts every so many gradient steps
        :param value: gradient steps
        :raises ConfigError: if it would act in the middle of a chunk of updates
        """
        if value > 0 and value % self.gradient_steps != 0:
            raise ConfigError(
                f"{name}={value} is no multiple of gradient_steps={self.gradient_steps}",
                key=name,
                hint="Make it one, or set gradient_steps=1: otherwise a callback would see more updates than it counts.",
            )

    def _count_steps(self, n_steps: int, callback: BaseCallback, log_interval: int | None) -> bool:
        """
        Count gradient steps and call the callback once for each.

        :return: False once the callback has asked to stop; the counters never lag behind the updates
        """
        # Names that Stable-Baselines3's callbacks look for among the locals of a rollout.
        assert self.env is not None
        new_obs = self._last_obs
        infos: list[dict[str, Any]] = [{}] * self.env.num_envs
        rewards, dones = np.zeros(self.env.num_envs), np.zeros(self.env.num_envs, dtype=bool)
        keep_going = True
        for _ in range(n_steps):
            self.num_timesteps += 1
            log_due = log_interval is not None and self.num_timesteps % log_interval == 0
            if log_due:
                self._record_metrics()
                self._record_time()
            elif self.num_timesteps % GUARD_INTERVAL == 0:
                self._refuse_divergence()
            if keep_going:
                callback.update_locals(locals())
                keep_going = bool(callback.on_step())
                if log_due and RECORDED in self.logger.name_to_value:  # else a callback has just written the row
                    self.dump_logs()
        del new_obs, infos, rewards, dones
        return keep_going
