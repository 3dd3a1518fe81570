"""The agents as algorithms of rl_zoo3, and the spaces in which its hyperparameter search looks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dce.agents import AGENTS

if TYPE_CHECKING:
    import optuna


Params = dict[str, Any]


def convert_bc_params(sampled_params: Params) -> Params:
    """
    Put the batch size in place of its exponent to the base of 2, which is what a trial draws.

    :param sampled_params: parameters of a trial
    :return: constructor keywords
    """
    params = dict(sampled_params)
    params["batch_size"] = 2 ** params.pop("batch_size_pow")
    return params


def convert_critic_params(sampled_params: Params) -> Params:
    """
    As :func:`convert_bc_params`, with gamma in place of its distance from 1, which a trial draws on a logarithmic scale.

    :param sampled_params: parameters of a trial of an agent with critics
    :return: constructor keywords
    """
    params = convert_bc_params(sampled_params)
    params["gamma"] = 1.0 - params.pop("one_minus_gamma")
    return params


def convert_dce_params(sampled_params: Params) -> Params:
    """
    As :func:`convert_critic_params`, with beta constant at the value of the trial.

    :param sampled_params: parameters of a trial of DCE
    :return: constructor keywords; a schedule in the row is switched off, since it belongs to another start value
    """
    return {**convert_critic_params(sampled_params), "beta_final": None, "beta_rate": 0.0}


def convert_pbrl_params(sampled_params: Params) -> Params:
    """
    As :func:`convert_critic_params`, with ``ood_weight`` constant at the value of the trial.

    :param sampled_params: parameters of a trial of PBRL
    :return: constructor keywords; a schedule in the row is switched off, since it belongs to another start value
    """
    return {**convert_critic_params(sampled_params), "ood_weight_final": None, "adaptive_ood_weight": False}


def _optimizer(trial: optuna.Trial) -> Params:
    return {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 10),
    }


def _bootstrap(trial: optuna.Trial) -> Params:
    return {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-3, 3e-2, log=True),
        "tau": trial.suggest_float("tau", 1e-3, 2e-2, log=True),
    }


def _beta(trial: optuna.Trial) -> Params:
    return {"beta": trial.suggest_float("beta", 0.03, 30.0, log=True)}


def _expectile(trial: optuna.Trial) -> Params:
    return {"expectile": trial.suggest_float("expectile", 0.5, 0.95)}


def _actor_rate(trial: optuna.Trial) -> Params:
    return {"actor_learning_rate": trial.suggest_float("actor_learning_rate", 1e-5, 1e-3, log=True)}


def _td3bc(trial: optuna.Trial) -> Params:
    return {"alpha": trial.suggest_float("alpha", 0.1, 20.0, log=True)}


def _iql(trial: optuna.Trial) -> Params:
    return {
        "temperature": trial.suggest_float("temperature", 0.1, 20.0, log=True),
        "actor_dropout": trial.suggest_float("actor_dropout", 0.0, 0.3),
    }


def _cql(trial: optuna.Trial) -> Params:
    return {"cql_weight": trial.suggest_float("cql_weight", 0.1, 20.0, log=True)}


def _pbrl(trial: optuna.Trial) -> Params:
    return {
        "uncertainty_coef": trial.suggest_float("uncertainty_coef", 1e-5, 0.1, log=True),
        "ood_weight": trial.suggest_float("ood_weight", 1e-3, 5.0, log=True),
        "ood_weight_next": trial.suggest_float("ood_weight_next", 1e-3, 1.0, log=True),
    }


def _uwac(trial: optuna.Trial) -> Params:
    return {
        "uwac_beta": trial.suggest_float("uwac_beta", 0.01, 10.0, log=True),
        "critic_dropout": trial.suggest_float("critic_dropout", 0.05, 0.3),
        "mmd_threshold": trial.suggest_float("mmd_threshold", 0.01, 0.3, log=True),
    }


class SearchSpace(NamedTuple):
    """
    Where the hyperparameter search looks.

    A trial is judged by evaluation in the simulator, so that what is found is tuned *online*: say so with results.

    :param convert: from what a trial holds to constructor keywords
    :param parts: each draws some parameters of a trial
    """

    convert: Callable[[Params], Params]
    parts: tuple[Callable[[optuna.Trial], Params], ...]

    def sample(self, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Params) -> Params:
        """
        Draw the parameters of all parts for a trial, and convert them; the signature is that of rl_zoo3's samplers.

        :param trial: trial of the search
        :param n_actions: unused, as the other arguments of rl_zoo3
        :param n_envs: unused
        :param additional_args: unused
        :return: constructor keywords
        """
        drawn: Params = {}
        for part in self.parts:
            drawn |= part(trial)
        return self.convert(drawn)


# Weights that have a schedule (DCE, PBRL) are searched as constants.
SPACES = {
    "dce": SearchSpace(convert_dce_params, (_optimizer, _bootstrap, _beta, _expectile)),
    "offline_bc": SearchSpace(convert_bc_params, (_optimizer,)),
    "offline_td3bc": SearchSpace(convert_critic_params, (_optimizer, _bootstrap, _td3bc)),
    "offline_iql": SearchSpace(convert_critic_params, (_optimizer, _bootstrap, _expectile, _iql)),
    "offline_sac": SearchSpace(convert_critic_params, (_optimizer, _bootstrap)),
    "sac_v": SearchSpace(convert_critic_params, (_optimizer, _bootstrap, _expectile)),
    "cql_eq18": SearchSpace(convert_critic_params, (_optimizer, _bootstrap, _beta)),
    "offline_cql": SearchSpace(convert_critic_params, (_optimizer, _bootstrap, _actor_rate, _cql)),
    "offline_pbrl": SearchSpace(convert_pbrl_params, (_optimizer, _bootstrap, _actor_rate, _pbrl)),
    "offline_uwac": SearchSpace(convert_critic_params, (_optimizer, _bootstrap, _actor_rate, _uwac)),
}
SAMPLERS = {algo: space.sample for algo, space in SPACES.items()}
CONVERTERS = {algo: space.convert for algo, space in SPACES.items()}


def register() -> dict[str, type[BaseAlgorithm]]:
    """
    Add the algorithms to rl_zoo3. Its modules share one dictionary, which is therefore changed in place.

    :return: all algorithms rl_zoo3 knows now
    :raises ModuleNotFoundError: without rl_zoo3
    """
    import rl_zoo3.import_envs  # noqa: F401  # registers the environments that its scripts know
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    ALGOS.update(AGENTS)
    HYPERPARAMS_SAMPLER.update(SAMPLERS)
    HYPERPARAMS_CONVERTER.update(CONVERTERS)
    return ALGOS
