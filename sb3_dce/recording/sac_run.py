"""
A SAC run after D4RL's procedure, for those who have no policies at hand: "medium" is the first policy that reaches a target,
its replay buffer is "medium-replay", and the same run goes on to "expert".

The run lives in a folder and can be stopped at any time; it goes on from its last evaluation.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_dce.checks import changed_settings
from sb3_dce.data.npz import arrays_from_npz, write_npz
from sb3_dce.envs import make_env
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.files import write_atomically, write_text
from sb3_dce.policy_parts import numpy_policy
from sb3_dce.recording.episodes import Arrays, EpisodeRunner, RecordingSpec, concatenate
from sb3_dce.recording.policy_files import write_npz_policy

# Beyond the seeds of recordings and of the evaluations of agents.
_EVALUATION_SEEDS = 2**32


@dataclass(frozen=True)
class SACSettings:
    """
    Settings of a run; the defaults are those of D4RL's SAC where Stable-Baselines3 has them.

    :param max_steps: environment steps; the policy after them is "expert"
    :param eval_freq: steps between two evaluations, which are also the checkpoints
    :param n_eval_episodes: deterministic episodes of each
    :param learning_starts: steps of random actions at the start
    :param batch_size: rows of a gradient step
    :param net_arch: widths of the hidden layers
    """

    max_steps: int = 1_000_000
    eval_freq: int = 10_000
    n_eval_episodes: int = 10
    learning_starts: int = 10_000
    batch_size: int = 256
    net_arch: tuple[int, ...] = (256, 256)

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name not in ("net_arch", "learning_starts") and value < 1:
                raise ConfigError(f"{name} must be at least 1, got {value}", key=name, hint="Leave it out for the default.")


class SACRun:
    """
    One run in one folder.

    :param env: id of the dataset or environment
    :param target: mean return (reward units) at which the policy is "medium"
    :param seed: of the run
    :param folder: where it lives
    :param settings: of the run
    :param progress: called with the steps done and the most there will be
    :param note: called with one line when it begins to train or goes on, and one per evaluation
    :raises ConfigError: if the folder holds a run with other settings
    :raises CheckpointError: if its ``state.json`` is damaged
    """

    def __init__(
        self,
        env: str,
        target: float,
        seed: int,
        folder: Path,
        settings: SACSettings,
        progress: Callable[[int, int], None] = lambda done, total: None,
        note: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.env, self.target, self.seed, self.folder = env, target, seed, folder
        self.settings, self.progress, self.note = settings, progress, note
        self._state: dict[str, Any] = {"steps": 0, "evaluations": [], "medium_at": None, "expert_at": None, "cuts": []}
        self._config = json.loads(json.dumps({"env": env, "target": target, "seed": seed, **asdict(settings)}))
        del self._config["max_steps"]  # a run may be made longer
        self._read_state()
        self._model: SAC | None = None

    def medium(self) -> Path:
        """
        Train until the target is reached, if it has not been.

        :return: NPZ file of the policy
        :raises ConfigError: if the run ends before
        """
        while self._state["medium_at"] is None:
            if self._state["steps"] >= self.settings.max_steps:
                best = max((mean for _, mean, _ in self._state["evaluations"]), default=float("nan"))
                raise ConfigError(
                    f"SAC has not reached a mean return of {self.target:g} in {self._state['steps']:,} steps, its best is "
                    f"{best:.0f}",
                    where=str(self.folder),
                    key="target",
                    hint="Allow more steps (--train-steps), lower --target, or try another --seed; say so with the results.",
                )
            self._train_until_next_evaluation()
        return self.folder / "medium.npz"

    def expert(self) -> Path:
        """
        Train to the end.

        :return: NPZ file of the policy
        :raises ConfigError: if the run is longer already
        """
        if self._state["steps"] > self.settings.max_steps:
            raise ConfigError(
                f"the run has made {self._state['steps']:,} steps, more than {self.settings.max_steps:,}",
                where=str(self.folder),
                key="max_steps",
                hint="Ask for at least as many, or delete the folder.",
            )
        while self._state["expert_at"] != self.settings.max_steps:
            self._train_until_next_evaluation()
        return self.folder / "expert.npz"

    def replay(self) -> Arrays:
        """
        The replay buffer up to the moment at which the policy was "medium".

        :return: rows in D4RL's layout, without next observations; the last episode may be open
        """
        self.medium()
        arrays = self._rows()
        del arrays["next_observations"]
        rows = {key: array[: self._state["medium_at"]] for key, array in arrays.items()}
        return {key: array.astype(np.float32) if array.dtype.kind == "f" else array for key, array in rows.items()}

    @property
    def steps(self) -> int:
        """Environment steps up to the last evaluation, from which an interrupted run goes on."""
        return int(self._state["steps"])

    @property
    def evaluations(self) -> list[tuple[int, float, float]]:
        """Steps, mean return and its standard deviation (reward units) of each evaluation so far, in order."""
        return [(int(steps), float(mean), float(std)) for steps, mean, std in self._state["evaluations"]]

    def _train_until_next_evaluation(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        if self._model is None:
            self.note(f"training SAC from step {self.steps:,} on, about an hour per 300,000 steps on one core")
        model = self._loaded_model()
        before = self.steps
        until = min(before + self.settings.eval_freq, self.settings.max_steps)
        reporting = _ReportSteps(self.progress, self.settings.max_steps)
        try:
            model.learn(until - before, callback=reporting, reset_num_timesteps=False)
        except BaseException:
            self._model = None  # it is ahead of the checkpoint
            raise
        returns = self._evaluate(model)
        self._state["steps"] = until
        self._state["evaluations"].append([until, float(returns.mean()), float(returns.std())])
        self.note(f"SAC after {until:,} steps: return {returns.mean():.1f} ± {returns.std():.1f}, medium is {self.target:g}")
        if self._state["medium_at"] is None and returns.mean() >= self.target:
            self._write_policy(model, "medium.npz")
            self._state["medium_at"] = until
        if until == self.settings.max_steps:
            self._write_policy(model, "expert.npz")
            self._state["expert_at"] = until
        self._save(model, before)

    def _evaluate(self, model: SAC) -> np.ndarray:
        actor = numpy_policy(model.policy)
        assert actor is not None
        seed = _EVALUATION_SEEDS + self.seed * self.settings.n_eval_episodes
        runner = EpisodeRunner(RecordingSpec("SAC", self.env, seed, deterministic=True), actor)
        returns = [runner.run(k)["rewards"].sum(dtype=np.float64) for k in range(self.settings.n_eval_episodes)]
        return np.array(returns)

    def _write_policy(self, model: SAC, name: str) -> None:
        actor = numpy_policy(model.policy)
        assert actor is not None
        mean = self._state["evaluations"][-1][1]
        meta = {
            "algo": "sac",
            "env": self.env,
            "source": f"sb3-dce datasets generate, SAC of Stable-Baselines3, seed {self.seed}",
            "steps": self.steps,
            "return": mean,
        }
        write_npz_policy(actor, self.folder / name, meta)

    # -- what is on the disk: replay/<from>-<to>.npz, then model-<steps>.zip, then state.json, which makes them valid -------

    def _save(self, model: SAC, before: int) -> None:
        buffer = model.replay_buffer
        assert isinstance(buffer, ReplayBuffer)
        rows = slice(before, self.steps)
        dones, timeouts = (array[rows, 0].astype(bool) for array in (buffer.dones, buffer.timeouts))
        arrays = {
            "observations": buffer.observations[rows, 0],
            "actions": buffer.actions[rows, 0],
            "rewards": buffer.rewards[rows, 0],
            "terminals": dones & ~timeouts,
            "timeouts": timeouts,
            "next_observations": buffer.next_observations[rows, 0],
        }
        write_npz(self.folder / "replay" / f"{before}-{self.steps}.npz", arrays)
        with write_atomically(self.folder / f"model-{self.steps}.zip") as stream:
            model.save(stream)  # type: ignore[arg-type]
        state = {"config": self._config, **self._state}
        write_text(self.folder / "state.json", json.dumps(state, indent=1))
        for old in self.folder.glob("model-*.zip"):
            if old.name != f"model-{self.steps}.zip":
                old.unlink()

    def _read_state(self) -> None:
        path = self.folder / "state.json"
        if not path.is_file():
            return
        try:
            state = json.loads(path.read_text(encoding="utf-8"))
            begun = dict(state.pop("config"))
            ends = [until for until, _, _ in state["evaluations"]]
            if not state.keys() >= self._state.keys() or state["steps"] != (ends or [0])[-1]:
                raise ValueError("not the state of a run")
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise CheckpointError(
                f"damaged ({error})", where=str(path), path=path, hint="Delete the folder; the run starts anew."
            ) from error
        if changes := changed_settings(begun, self._config):
            raise ConfigError(
                f"the folder holds a run with other settings: {', '.join(changes)}",
                where=str(self.folder),
                path=self.folder,
                hint="Give those settings again, or delete the folder.",
            )
        self._state = state

    def _rows(self) -> Arrays:
        """
        All rows so far. Where the run was interrupted an episode ends without a terminal, as at a time limit.

        Parts end where evaluations were made; another one was left by a run that was killed, and then made longer.
        """
        parts, start = [], 0
        for until, _, _ in self.evaluations:
            path = self.folder / "replay" / f"{start}-{until}.npz"
            if not path.is_file():
                raise CheckpointError(
                    f"the replay buffer lacks the rows from {start:,} on",
                    where=str(self.folder),
                    path=self.folder,
                    hint="Delete the folder; the run starts anew.",
                )
            parts.append(arrays_from_npz(path))
            start = until
        arrays = concatenate(parts)
        arrays["timeouts"][self._state["cuts"]] = True
        return arrays

    def _loaded_model(self) -> SAC:
        if self._model is not None:
            return self._model
        env = make_env(self.env)
        if self.steps == 0:
            self._model = SAC(
                "MlpPolicy",
                env,
                buffer_size=self.settings.max_steps,
                learning_starts=self.settings.learning_starts,
                batch_size=self.settings.batch_size,
                policy_kwargs={"net_arch": list(self.settings.net_arch)},
                seed=self.seed,
            )
            return self._model
        path = self.folder / f"model-{self.steps}.zip"
        if not path.is_file():
            raise CheckpointError(
                "the checkpoint of the run is missing",
                where=str(path),
                path=path,
                hint="Delete the folder; the run starts anew.",
            )
        model = SAC.load(path, env, custom_objects={"buffer_size": self.settings.max_steps})
        # not the states of the first episodes again
        model.set_random_seed(self.seed + self.steps)
        self._refill(model)
        self._model = model
        return model

    def _refill(self, model: SAC) -> None:
        arrays = self._rows()
        if not (arrays["terminals"][-1] or arrays["timeouts"][-1]):
            arrays["timeouts"][-1] = True
            self._state["cuts"].append(self.steps - 1)
        buffer = model.replay_buffer
        assert isinstance(buffer, ReplayBuffer)
        for key in ("observations", "actions", "rewards", "timeouts", "next_observations"):
            getattr(buffer, key)[: self.steps, 0] = arrays[key]
        buffer.dones[: self.steps, 0] = arrays["terminals"] | arrays["timeouts"]
        buffer.pos = self.steps % buffer.buffer_size
        buffer.full = self.steps >= buffer.buffer_size


class _ReportSteps(BaseCallback):
    def __init__(self, progress: Callable[[int, int], None], total: int) -> None:
        super().__init__()
        self._progress, self._total = progress, total

    def _on_step(self) -> bool:
        if self.num_timesteps % 50 == 0:
            self._progress(self.num_timesteps, self._total)
        return True
