"""Fixtures shared by the tests: a small steppable environment, data recorded in it, and the same data as a file."""

from __future__ import annotations

import os
import re
import signal
import site
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from agents_under_test import AGENTS, Agent
from gymnasium import spaces
from hypothesis import settings

from sb3_dce import Transitions
from sb3_dce.data import write_hdf5
from sb3_dce.envs import SpacesEnv

pytest.register_assert_rewrite("update_tools")  # so that its checks say what differs, as those of the tests do

# the same examples every time, on every machine
settings.register_profile("fixed", derandomize=True, database=None)
settings.load_profile("fixed")

OBS_DIM, ACT_DIM, N_ROWS = 5, 2, 300
OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float64)
ACTION_SPACE = spaces.Box(-1.0, 1.0, (ACT_DIM,), np.float32)


class PointMass(gym.Env):
    """
    A point pushed over a plane. Leaving the unit disc ends the task; after 20 steps the time limit ends the episode.

    The observation is position (2), velocity (2), elapsed share of the time limit; the reward is 3 minus the distance to the
    middle, which is above every penalty the tests use, so that living pays.
    """

    observation_space = OBSERVATION_SPACE
    action_space = ACTION_SPACE
    max_steps = 20

    def __init__(self) -> None:
        self.position, self.velocity, self.elapsed = np.zeros(2), np.zeros(2), 0

    def _observation(self) -> np.ndarray:
        return np.concatenate([self.position, self.velocity, [self.elapsed / self.max_steps]])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.velocity, self.elapsed = self.np_random.uniform(-0.6, 0.6, 2), np.zeros(2), 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.velocity = 0.8 * self.velocity + 0.1 * np.clip(action, -1.0, 1.0)
        self.position = self.position + self.velocity
        self.elapsed += 1
        distance = float(np.linalg.norm(self.position))
        return self._observation(), 3.0 - distance, distance > 1.0, self.elapsed >= self.max_steps, {}


def recorded_arrays(n_rows: int = N_ROWS) -> dict[str, np.ndarray]:
    """Rows of a random policy in :class:`PointMass`, in D4RL's layout; the last episode may be open."""
    env, rng = PointMass(), np.random.default_rng(0)
    rows: dict[str, list[Any]] = {
        key: [] for key in ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations")
    }
    obs, _ = env.reset(seed=0)
    for _ in range(n_rows):
        action = rng.uniform(-1.0, 1.0, ACT_DIM)
        following, reward, terminated, truncated, _ = env.step(action)
        step = (obs, action, reward, terminated, truncated and not terminated, following)
        for values, value in zip(rows.values(), step, strict=True):
            values.append(value)
        obs = env.reset()[0] if terminated or truncated else following
    arrays = {key: np.asarray(values) for key, values in rows.items()}
    return {key: values.astype(np.float32) if values.dtype == np.float64 else values for key, values in arrays.items()}


# what the package, Minari, the hub behind it and downloads read of a user's settings
OF_THE_USER = re.compile(r"(SB3_DCE|MINARI|HF|D4RL)_|XDG_CACHE_HOME$|\w+_PROXY$", re.IGNORECASE)


@pytest.fixture(autouse=True, scope="session")
def empty_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A user without data, settings, mirrors and proxies. A test that puts something into the home makes one of its own."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    with pytest.MonkeyPatch.context() as patch:
        # matplotlib's list of fonts takes seconds to make, and packages may be installed for the user alone
        patch.setenv("MPLCONFIGDIR", os.environ.get("MPLCONFIGDIR") or str(cache / "matplotlib"))
        patch.setenv("PYTHONUSERBASE", site.getuserbase())
        for name in filter(OF_THE_USER.match, list(os.environ)):
            patch.delenv(name)
        patch.setenv("HOME", str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    th.set_num_threads(1)


@pytest.fixture(scope="session")
def arrays() -> dict[str, np.ndarray]:
    return recorded_arrays()


@pytest.fixture(scope="session")
def transitions(arrays: dict[str, np.ndarray]) -> Transitions:
    """300 rows in several episodes, some of which end at a terminal and some at the time limit."""
    made = Transitions.from_arrays(**arrays)
    assert made.info.n_terminals > 2 and made.info.n_timeouts > 2 and len(made) == N_ROWS
    return made


@pytest.fixture
def hdf5_file(arrays: dict[str, np.ndarray], tmp_path: Path) -> Path:
    path = tmp_path / "point-mass.hdf5"
    write_hdf5(path, arrays)
    return path


@pytest.fixture
def spaces_env() -> SpacesEnv:
    return SpacesEnv(OBSERVATION_SPACE, ACTION_SPACE)


@pytest.fixture
def point_mass() -> PointMass:
    return PointMass()


@pytest.fixture(scope="session")
def make_point_mass() -> Callable[[], PointMass]:
    return PointMass


@pytest.fixture(scope="session")
def random_transitions() -> Callable[..., Transitions]:
    """A function that makes data of any width: no episode structure, actions uniform in ``[-high, high]``."""

    def make(n_rows: int = 100, obs_dim: int = OBS_DIM, act_dim: int = ACT_DIM, high: float = 1.0) -> Transitions:
        rng = np.random.default_rng(0)
        ends = np.zeros(n_rows, dtype=bool)
        ends[9::10] = True
        return Transitions.from_arrays(
            rng.standard_normal((n_rows, obs_dim)).astype(np.float32),
            rng.uniform(-high, high, (n_rows, act_dim)).astype(np.float32),
            rng.uniform(2.0, 4.0, n_rows).astype(np.float32),
            np.zeros(n_rows, dtype=bool),
            ends,
            action_low=-high,
            action_high=high,
        )

    return make


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Python's own handler, which a process in the background of a script does not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def legends(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """What the legend of each picture of curves says that is written from now on."""
    figure = pytest.importorskip("matplotlib.figure").Figure
    original, found = figure.savefig, []

    def savefig(self: Any, *args: Any, **kwargs: Any) -> None:
        found.append([text.get_text() for text in self.axes[0].get_legend().get_texts()])
        original(self, *args, **kwargs)

    monkeypatch.setattr(figure, "savefig", savefig)
    return found


@pytest.fixture(params=AGENTS)
def agent(request: pytest.FixtureRequest) -> Agent:
    return AGENTS[request.param]
