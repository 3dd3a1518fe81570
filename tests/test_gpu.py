"""What only a CUDA device can show: ``pytest -m gpu``. Everything else about these paths is tested on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from update_tools import all_tensors, largest_difference, to_float64

from sb3_dce import OfflineBC, OfflineDCE, Transitions
from sb3_dce.agents import AGENTS
from sb3_dce.population import Population
from sb3_dce.warm_up import ActorWarmUp

pytestmark = pytest.mark.gpu
SMALL = {"batch_size": 8, "policy_kwargs": {"net_arch": [16, 16]}, "seed": 0, "learning_rate": 1e-3}


def make(data: Transitions, agent: Any = OfflineDCE, **kwargs: Any) -> Any:
    settings = {"device": "cuda", **SMALL, **kwargs}
    if issubclass(agent, ActorWarmUp):
        settings.setdefault("policy_eval_start", 20)  # within the updates of a test
    model = agent("MlpPolicy", dataset=data, **settings)
    model.attach_dataset()
    return to_float64(model)


@pytest.mark.parametrize("algo", AGENTS)
def test_captured_updates_equal_eager_ones(algo: str, transitions: Transitions) -> None:
    eager, captured = (make(transitions, AGENTS[algo], execution=execution) for execution in ("eager", "cudagraph"))
    for model in (eager, captured):
        for _ in range(5):
            model.train(10, model.batch_size)
    assert captured._engine.execution == "cudagraph"
    assert largest_difference(all_tensors(eager), all_tensors(captured)) <= 1e-10
    one, other = eager.read_metrics(), captured.read_metrics()
    one.pop("sec_per_1000"), other.pop("sec_per_1000")
    assert other == pytest.approx(one, rel=1e-9, abs=1e-9)


def test_changed_settings_reach_a_captured_update(transitions: Transitions) -> None:
    eager, captured = (make(transitions, execution=execution, beta=1.0) for execution in ("eager", "cudagraph"))
    for model in (eager, captured):
        model.train(10, 8)
        model.beta, model.learning_rate = 3.0, 1e-4
        model._setup_lr_schedule()
        model.train(10, 8)
    assert largest_difference(all_tensors(eager), all_tensors(captured)) <= 1e-10


def test_replays_use_new_noise_and_new_rows(transitions: Transitions) -> None:
    model = make(transitions, execution="cudagraph")
    model.train(5, 8)
    before = [model.read_metrics()["entropy"]]
    for _ in range(3):
        model.train(1, 8)
        before.append(model.read_metrics()["entropy"])
    assert len(set(before)) == 4


def test_a_captured_update_follows_the_batch_size_the_seed_and_the_data(
    transitions: Transitions, random_transitions: Callable[..., Transitions]
) -> None:
    eager, captured = (make(transitions, execution=execution) for execution in ("eager", "cudagraph"))
    for model in (eager, captured):
        for batch_size in (8, 12, 8):
            model.train(6, batch_size)
        model.set_random_seed(3)
        model.train(6, 8)
        model.set_dataset(random_transitions(60))
        model.train(6, 8)
    assert largest_difference(all_tensors(eager), all_tensors(captured)) <= 1e-10


def test_a_saved_captured_run_goes_on_with_the_same_numbers(transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineDCE("MlpPolicy", dataset=transitions, device="cuda", execution="cudagraph", **SMALL).learn(20)
    model.save(tmp_path / "model.zip")
    loaded = OfflineDCE.load(tmp_path / "model.zip", device="cuda")
    loaded.set_dataset(transitions)
    for each in (model, loaded):
        each.learn(10, reset_num_timesteps=False)
    assert largest_difference(all_tensors(model), all_tensors(loaded)) <= 1e-5


def test_a_thousand_replays_allocate_nothing(transitions: Transitions) -> None:
    model = make(transitions, execution="cudagraph")
    model.train(20, 8)
    th.cuda.synchronize()
    before = th.cuda.memory_allocated()
    model.train(1000, 8)
    th.cuda.synchronize()
    assert th.cuda.memory_allocated() <= before


def test_model_trained_on_the_device_goes_on_elsewhere(transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineDCE("MlpPolicy", dataset=transitions, device="cuda", execution="cudagraph", **SMALL).learn(20)
    model.save(tmp_path / "model.zip")
    obs = np.random.default_rng(0).standard_normal((4, 5))
    for device in ("cuda", "cpu"):
        loaded = OfflineDCE.load(tmp_path / "model.zip", device=device)
        here, there = model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0]
        assert np.allclose(here, there, atol=1e-5)
        loaded.set_dataset(transitions)
        assert loaded.learn(5, reset_num_timesteps=False)._n_updates == 25


@pytest.mark.parametrize("execution", ["eager", "cudagraph"])
def test_population_members_equal_runs_on_the_processor(execution: str, transitions: Transitions) -> None:
    settings = [{"seed": s, "beta": 1.0 + s, "device": "cpu"} for s in range(3)]
    singles = [make(transitions, **kwargs) for kwargs in settings]
    for single in singles:
        single.train(20, 8)
    population = Population([make(transitions, **k) for k in settings], "cuda", execution, own_randomness=True)
    population.train(20)
    for single, member in zip(singles, population.commit(), strict=True):
        assert largest_difference(all_tensors(single), all_tensors(member)) <= 1e-9


@pytest.mark.parametrize("normalize_obs", [False, True])
def test_population_that_draws_on_the_device_is_captured_with_its_draws(normalize_obs: bool, transitions: Transitions) -> None:
    members = []
    for execution in ("eager", "cudagraph"):
        models = [make(transitions, normalize_obs=normalize_obs, seed=s, beta=1.0 + s, device="cpu") for s in range(3)]
        population = Population(models, "cuda", execution)
        for _ in range(3):
            population.train(10)
        engine = population._engine
        assert engine is not None and (execution == "eager" or any(source is not None for _, source in engine._captured))
        members.append([all_tensors(model) for model in population.commit()])
    for eager, captured in zip(*members, strict=True):
        assert largest_difference(eager, captured) <= 1e-10
    assert largest_difference(*members[1][:2]) > 1e-3, "each member has rows and noise of its own"


def test_precision_that_is_changed_is_captured_anew(transitions: Transitions) -> None:
    model = make(transitions, execution="cudagraph")
    model.train(5, 8)
    model.precision = "tf32"
    model.train(5, 8)
    assert len(model._engine._captured) == 2


def test_tf32_is_switched_on_for_training_only(transitions: Transitions) -> None:
    before = th.backends.cuda.matmul.fp32_precision
    kwargs = {**SMALL, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}
    plain, rounded = (
        OfflineBC("MlpPolicy", dataset=transitions, device="cuda", precision=p, **kwargs).learn(5) for p in ("float32", "tf32")
    )
    assert th.backends.cuda.matmul.fp32_precision == before
    assert 0.0 < largest_difference(all_tensors(plain), all_tensors(rounded)) < 0.05
