"""The agents as algorithms of rl_zoo3, and the spaces in which its hyperparameter search looks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dce.agents import AGENTS

if TYPE_CHECKING:
    import optuna


def sample_dce_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of DCE; the penalty weight is searched as a constant.

    A trial is judged by evaluation in the simulator, so that what is found is tuned *online*: say so with results.

    :param trial: trial of the search
    :param n_actions: unused, as the other arguments of rl_zoo3
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    return convert_dce_params(
        {
            **_sample_optimizer(trial),
            **_sample_bootstrap(trial),
            "beta": trial.suggest_float("beta", 0.03, 30.0, log=True),
            "expectile": trial.suggest_float("expectile", 0.5, 0.95),
        }
    )


def convert_dce_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: parameters of a trial, as drawn by :func:`sample_dce_params`
    :return: constructor keywords; a schedule in the row is switched off, since it belongs to another start value
    """
    return {**convert_critic_params(sampled_params), "beta_final": None, "beta_rate": 0.0}


def sample_bc_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of behavioural cloning; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    return convert_bc_params(_sample_optimizer(trial))


def convert_bc_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: parameters of a trial, as drawn by :func:`sample_bc_params`
    :return: constructor keywords
    """
    params = dict(sampled_params)
    params["batch_size"] = 2 ** params.pop("batch_size_pow")
    return params


def sample_td3bc_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of TD3+BC; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    drawn = {
        **_sample_optimizer(trial),
        **_sample_bootstrap(trial),
        "alpha": trial.suggest_float("alpha", 0.1, 20.0, log=True),
    }
    return convert_critic_params(drawn)


def sample_iql_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of IQL; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    return convert_critic_params(
        {
            **_sample_optimizer(trial),
            **_sample_bootstrap(trial),
            "expectile": trial.suggest_float("expectile", 0.5, 0.95),
            "temperature": trial.suggest_float("temperature", 0.1, 20.0, log=True),
            "actor_dropout": trial.suggest_float("actor_dropout", 0.0, 0.3),
        }
    )


def sample_sac_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of SAC on a dataset; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    return convert_critic_params({**_sample_optimizer(trial), **_sample_bootstrap(trial)})


def sample_sac_v_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of SAC with V; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    drawn = {**_sample_optimizer(trial), **_sample_bootstrap(trial)}
    return convert_critic_params({**drawn, "expectile": trial.suggest_float("expectile", 0.5, 0.95)})


def sample_cql_eq18_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Draw hyperparameters of the paper's Eq. 18 agent; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    drawn = {**_sample_optimizer(trial), **_sample_bootstrap(trial)}
    return convert_critic_params({**drawn, "beta": trial.suggest_float("beta", 0.03, 30.0, log=True)})


def sample_uwac_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of UWAC; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    return convert_critic_params(
        {
            **_sample_optimizer(trial),
            **_sample_bootstrap(trial),
            "uwac_beta": trial.suggest_float("uwac_beta", 0.01, 10.0, log=True),
            "critic_dropout": trial.suggest_float("critic_dropout", 0.05, 0.3),
            "mmd_threshold": trial.suggest_float("mmd_threshold", 0.01, 0.3, log=True),
        }
    )


def sample_cql_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of CQL; see :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    return convert_critic_params(
        {
            **_sample_optimizer(trial),
            **_sample_bootstrap(trial),
            "actor_learning_rate": trial.suggest_float("actor_learning_rate", 1e-5, 1e-3, log=True),
            "cql_weight": trial.suggest_float("cql_weight", 0.1, 20.0, log=True),
        }
    )


def sample_pbrl_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters of PBRL; the weight at s is searched as a constant. See :func:`sample_dce_params`.

    :param trial: trial of the search
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor keywords
    """
    return convert_pbrl_params(
        {
            **_sample_optimizer(trial),
            **_sample_bootstrap(trial),
            "actor_learning_rate": trial.suggest_float("actor_learning_rate", 1e-5, 1e-3, log=True),
            "uncertainty_coef": trial.suggest_float("uncertainty_coef", 1e-5, 0.1, log=True),
            "ood_weight": trial.suggest_float("ood_weight", 1e-3, 5.0, log=True),
            "ood_weight_next": trial.suggest_float("ood_weight_next", 1e-3, 1.0, log=True),
        }
    )


def convert_pbrl_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: parameters of a trial, as drawn by :func:`sample_pbrl_params`
    :return: constructor keywords; a schedule in the row is switched off, since it belongs to another start value
    """
    return {**convert_critic_params(sampled_params), "ood_weight_final": None, "adaptive_ood_weight": False}


def convert_critic_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: parameters of a trial of an agent with critics
    :return: constructor keywords
    """
    params = convert_bc_params(sampled_params)
    params["gamma"] = 1.0 - params.pop("one_minus_gamma")
    return params


def _sample_bootstrap(trial: optuna.Trial) -> dict[str, Any]:
    return {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-3, 3e-2, log=True),
        "tau": trial.suggest_float("tau", 1e-3, 2e-2, log=True),
    }


def _sample_optimizer(trial: optuna.Trial) -> dict[str, Any]:
    return {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 10),
    }


SAMPLERS: dict[str, Callable[..., dict[str, Any]]] = {
    "dce": sample_dce_params,
    "offline_bc": sample_bc_params,
    "offline_td3bc": sample_td3bc_params,
    "offline_iql": sample_iql_params,
    "offline_sac": sample_sac_params,
    "sac_v": sample_sac_v_params,
    "cql_eq18": sample_cql_eq18_params,
    "offline_cql": sample_cql_params,
    "offline_pbrl": sample_pbrl_params,
    "offline_uwac": sample_uwac_params,
}
CONVERTERS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "dce": convert_dce_params,
    "offline_bc": convert_bc_params,
    "offline_td3bc": convert_critic_params,
    "offline_iql": convert_critic_params,
    "offline_sac": convert_critic_params,
    "sac_v": convert_critic_params,
    "cql_eq18": convert_critic_params,
    "offline_cql": convert_critic_params,
    "offline_pbrl": convert_pbrl_params,
    "offline_uwac": convert_critic_params,
}


def register() -> dict[str, type[BaseAlgorithm]]:
    """
    Add the algorithms to rl_zoo3. Its modules share one dictionary, which is therefore changed in place.

    :return: all algorithms rl_zoo3 knows now
    :raises ModuleNotFoundError: without rl_zoo3
    """
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    ALGOS.update(AGENTS)
    HYPERPARAMS_SAMPLER.update(SAMPLERS)
    HYPERPARAMS_CONVERTER.update(CONVERTERS)
    return ALGOS
