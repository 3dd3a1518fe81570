"""
Policies from files: zip files of Stable-Baselines3 and of this package, and plain arrays (``.npz``).

A zip file of Stable-Baselines3 contains pickles, and so do the statistics of ``VecNormalize``: opening them runs code of
whoever made them. An NPZ file is data only.
"""

from __future__ import annotations

import functools
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_dce.data.hashes import file_sha256
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.files import expanded, write_atomically
from sb3_dce.numpy_policy import (
    ACTIVATIONS,
    Layer,
    MLPPolicy,
    NumpyPolicy,
    ObsNormalizer,
    PredictPolicy,
    RandomPolicy,
    Squash,
)
from sb3_dce.policy_parts import numpy_policy

_SB3 = ("sac", "td3", "ddpg", "ppo", "a2c")
_CONTRIB = ("tqc", "trpo", "crossq")
# Where the time feature of a saved policy reaches 0 (all published ones were trained with 1000 steps).
_TIME_LIMIT = 1000


@dataclass(frozen=True)
class PolicyFacts:
    """
    What a dataset says about the policy that acted.

    :param name: algorithm and file, for people
    :param sha256: of the file, ``None`` for the random policy
    :param normalization_sha256: of the file with the ``VecNormalize`` statistics
    :param source: where the policy comes from
    :param licence: of the policy
    :param note: what the user should know
    """

    name: str
    sha256: str | None = None
    normalization_sha256: str | None = None
    source: str | None = None
    licence: str | None = None
    note: str | None = None


def load_policy(
    source: str,
    observation_space: spaces.Box,
    action_space: spaces.Box,
    algo: str | None = None,
    vecnormalize: str | None = None,
) -> tuple[NumpyPolicy, PolicyFacts]:
    """
    A policy that fits an environment.

    :param source: ``random``, or a file ``.zip`` or ``.npz``
    :param observation_space: of the environment, one-dimensional
    :param action_space: of the environment, one-dimensional
    :param algo: algorithm of a zip file; default: what the file says
    :param vecnormalize: file with the statistics of ``VecNormalize``, for zip files
    :return: the policy, and what there is to say about it
    :raises ConfigError: if it does not fit the environment, or a parameter is wrong
    :raises CheckpointError: if the file is missing, damaged or of an unknown kind
    """
    path = expanded(source)
    if path.suffix != ".zip" and (algo or vecnormalize):
        raise ConfigError(
            f"algo and vecnormalize belong to a zip file of Stable-Baselines3, the policy is {source!r}",
            key="algo" if algo else "vecnormalize",
            hint="Leave them out.",
        )
    policy: NumpyPolicy
    if source == "random":
        facts = PolicyFacts("random: uniform on the action space")
        return RandomPolicy(observation_space.shape[0], action_space.low, action_space.high), facts
    if path.suffix not in (".npz", ".zip"):
        raise ConfigError(
            f"policy must be 'random' or a .zip or .npz file, got {source!r}",
            key="policy",
            hint="Give the file that model.save() has written.",
        )
    if not path.is_file():
        raise CheckpointError("no such file", where=str(path), path=path, hint="Give the path of a saved policy.")
    if path.suffix == ".npz":
        policy, facts = read_npz_policy(path)
    else:
        policy, facts = _from_zip(path, observation_space, action_space, algo, vecnormalize)
    _check_fit(policy, path, observation_space, action_space)
    return policy, facts


def read_npz_policy(path: Path) -> tuple[MLPPolicy, PolicyFacts]:
    """
    A policy stored as plain arrays; nothing is unpickled. Two layouts are known.

    Both have ``w0, b0, w1, b1, ...``, weights of shape (out, in), and act in [-1, 1]. With ``meta``, UTF-8 bytes of a JSON
    object (algo, activation, squash, time_feature, n_layers; source and licence if known): ``logstd_w`` and ``logstd_b``, or
    ``log_std``, or neither; ``obs_mean``, ``obs_var``, ``norm_eps``, ``clip_obs`` if observations are normalised. Without
    it the policies of hand_dapg: tanh, ``in_shift, in_scale, out_shift, out_scale, log_std``.

    :param path: file
    :return: the policy, and what there is to say about it
    :raises CheckpointError: if the file is damaged or has another layout
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        policy, meta = _policy_of_arrays(arrays)
    except Exception as error:  # whatever NumPy raises on a damaged archive or header
        raise CheckpointError(
            f"not a policy ({type(error).__name__}: {error})",
            where=str(path),
            path=path,
            hint="The file is damaged or has another layout; the layouts are described in read_npz_policy.",
        ) from error
    facts = PolicyFacts(
        name=f"{meta.get('algo', 'policy')} ({path.name})",
        sha256=file_sha256(path),
        source=meta.get("source"),
        licence=meta.get("licence"),
    )
    return policy, facts


def write_npz_policy(policy: MLPPolicy, path: Path, meta: dict[str, Any]) -> None:
    """
    Store an MLP policy without observation normalisation, in the layout of :func:`read_npz_policy`.

    :param policy: acts in [-1, 1]
    :param path: file to write, atomically
    :param meta: what is known about it besides its layout: algo, env, source, licence, ...
    """
    assert policy.normalizer is None and policy.time_limit is None and policy.squash != "mean"
    assert (policy.low == -1).all() and (policy.high == 1).all()
    arrays: dict[str, Any] = {}
    for number, (weight, bias) in enumerate(policy.layers):
        arrays[f"w{number}"], arrays[f"b{number}"] = weight.T.astype(np.float32), bias.astype(np.float32)
    if isinstance(policy.log_std, tuple):
        arrays["logstd_w"], arrays["logstd_b"] = (part.T.astype(np.float32) for part in policy.log_std)
    elif policy.log_std is not None:
        arrays["log_std"] = policy.log_std.astype(np.float32)
    layout = {
        "activation": policy.activation,
        "squash": policy.squash == "draw",
        "time_feature": False,
        "n_layers": len(policy.layers),
    }
    arrays["meta"] = np.frombuffer(json.dumps({**meta, **layout}).encode(), dtype=np.uint8)
    with write_atomically(path) as stream:
        np.savez(stream, **arrays)


def _policy_of_arrays(arrays: dict[str, np.ndarray]) -> tuple[MLPPolicy, dict[str, Any]]:
    _check_numbers(arrays)
    n_layers = sum(name[:1] == "w" and name[1:].isdigit() for name in arrays)
    layers: list[Layer] = [(arrays[f"w{i}"].T, arrays[f"b{i}"]) for i in range(n_layers)]
    _check_chain(layers)
    _check_vectors(arrays, len(layers[0][0]), len(layers[-1][1]))
    box = np.ones(len(layers[-1][1]))
    if "meta" not in arrays:
        weight, bias = (np.asarray(part, dtype=np.float64) for part in layers[-1])
        scale = arrays["out_scale"].astype(np.float64)
        head = (weight * scale, bias * scale + arrays["out_shift"])
        normalizer = ObsNormalizer(arrays["in_shift"].astype(np.float64), arrays["in_scale"].astype(np.float64) + 1e-8)
        policy = MLPPolicy([*layers[:-1], head], "tanh", -box, box, "none", arrays["log_std"], normalizer)
        return policy, {"algo": "dapg"}
    meta = json.loads(bytes(arrays["meta"]))
    if meta["activation"] not in ACTIVATIONS or meta["n_layers"] != n_layers:
        raise ValueError(f"{n_layers} layers with activation {meta['activation']!r}, {meta['n_layers']} announced")
    log_std: Layer | np.ndarray | None = arrays.get("log_std")
    if "logstd_w" in arrays:
        log_std = (arrays["logstd_w"].T, arrays["logstd_b"])
        _check_chain([*layers[:-1], log_std])
    statistics = None
    if "obs_mean" in arrays:
        scale = np.sqrt(arrays["obs_var"].astype(np.float64) + arrays["norm_eps"])
        statistics = ObsNormalizer(arrays["obs_mean"].astype(np.float64), scale, float(arrays["clip_obs"]))
    time_limit = _TIME_LIMIT if meta["time_feature"] else None
    squash: Squash = "draw" if meta["squash"] else "none"
    return MLPPolicy(layers, meta["activation"], -box, box, squash, log_std, statistics, time_limit), meta


def _check_numbers(arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        if name != "meta" and not (array.dtype.kind == "f" and np.isfinite(array).all()):
            raise ValueError(f"{name} must hold finite floating-point numbers")


def _check_chain(layers: list[Layer]) -> None:
    """Each layer must take what the one before gives."""
    for number, (weight, bias) in enumerate(layers):
        before = weight.shape[0] if number == 0 else layers[number - 1][0].shape[1]
        if weight.shape != (before, len(bias)):
            raise ValueError(f"layer {number} has weights {weight.T.shape} and {len(bias)} biases, and gets {before} inputs")


def _check_vectors(arrays: dict[str, np.ndarray], obs_dim: int, act_dim: int) -> None:
    """Each must have a number for every entry, which broadcasting would not ask for; a variance is no negative one."""
    widths = dict.fromkeys(("obs_mean", "obs_var", "in_shift", "in_scale"), obs_dim)
    widths |= dict.fromkeys(("out_shift", "out_scale", "log_std"), act_dim)
    for name, width in widths.items():
        if name in arrays and arrays[name].shape != (width,):
            raise ValueError(f"{name} has shape {arrays[name].shape}, wanted is ({width},)")
    if "obs_var" in arrays and (arrays["obs_var"] + arrays["norm_eps"] <= 0.0).any():
        raise ValueError("obs_var plus norm_eps must be positive")


def _from_zip(
    path: Path, observation_space: spaces.Box, action_space: spaces.Box, algo: str | None, vecnormalize: str | None
) -> tuple[NumpyPolicy, PolicyFacts]:
    algo = algo or detect_algo(path)
    model_policy = _load_zip(path, algo)
    normalizer = None if vecnormalize is None else _read_vecnormalize(Path(vecnormalize), model_policy)
    policy: NumpyPolicy | None = numpy_policy(model_policy, normalizer)
    note = None
    if policy is None:
        for space in (model_policy.observation_space, model_policy.action_space):
            if not isinstance(space, spaces.Box) or len(space.shape) != 1:
                raise ConfigError(
                    f"the policy has the space {space}; only vectors can be recorded",
                    where=str(path),
                    key="policy",
                    hint="Use a policy whose observations and actions are one-dimensional boxes.",
                )
        load = functools.partial(_load_zip, path, algo)
        low, high = model_policy.action_space.low, model_policy.action_space.high
        policy = PredictPolicy(load, model_policy.observation_space.shape[0], low, high, normalizer)
        note = f"{algo} in {path.name} is no plain MLP policy: its own predict is used, which is several times slower"
    elif not policy.is_stochastic:
        note = f"{algo} has a deterministic policy: without noise every episode follows from its initial state"
    statistics = None if vecnormalize is None else file_sha256(vecnormalize)
    return policy, PolicyFacts(f"{algo} ({path.name})", file_sha256(path), statistics, note=note)


def detect_algo(path: Path) -> str:
    """
    The algorithm of a zip file, from its readable part; nothing is unpickled.

    :param path: file
    :return: name of the algorithm
    :raises CheckpointError: if it is no saved model
    :raises ConfigError: if the algorithm cannot be told
    """
    from sb3_dce.saving import saved_algo

    own = saved_algo(path)
    if own is not None:
        return own
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    policy_class = data.get("policy_class")
    module = str(policy_class.get("__module__", "")) if isinstance(policy_class, dict) else ""
    for name in ("sac", "tqc", "crossq"):
        if f".{name}.policies" in module:
            return name
    if ".td3.policies" in module:
        return "td3"  # a DDPG model is one, too
    if module == "stable_baselines3.common.policies":
        return "trpo" if "cg_max_steps" in data else "ppo" if "clip_range" in data else "a2c"
    raise ConfigError(
        f"cannot tell the algorithm from the policy class ({module or 'not named'})",
        where=str(path),
        key="algo",
        hint=f"Name it: --algo with one of {', '.join((*_SB3, *_CONTRIB))}.",
    )


def _load_zip(path: Path, algo: str) -> Any:
    """The policy in a zip file, on the CPU and ready to act."""
    from sb3_dce.agents import AGENTS

    if algo in AGENTS:
        return AGENTS[algo].load(path, device="cpu").policy
    model_class = _model_class(algo)
    # Schedules are pickled functions of another Python version at worst, and none is needed to act; nor is a buffer.
    unneeded = {"learning_rate": 0.0, "lr_schedule": _zero, "clip_range": _zero, "clip_range_vf": None, "buffer_size": 1}
    try:
        policy = model_class.load(path, device="cpu", custom_objects=unneeded).policy
    except Exception as error:  # whatever the pickles in the file do
        raise CheckpointError(
            f"Stable-Baselines3 cannot load it as {algo} ({type(error).__name__}: {error})",
            where=str(path),
            path=path,
            hint="Check --algo, and that the packages of its custom classes are installed.",
        ) from error
    policy.set_training_mode(False)
    return policy


def _zero(progress: float) -> float:
    return 0.0


def _model_class(algo: str) -> Any:
    import stable_baselines3

    if algo in _SB3:
        return getattr(stable_baselines3, algo.upper())
    if algo in _CONTRIB:
        try:
            import sb3_contrib
        except ImportError:
            raise ConfigError(
                f"{algo} models need the package 'sb3_contrib'", key="algo", hint="Install it with: pip install sb3_contrib"
            ) from None
        return getattr(sb3_contrib, "CrossQ" if algo == "crossq" else algo.upper())
    from sb3_dce.agents import AGENTS

    raise ConfigError(f"unknown algorithm {algo!r}", key="algo", hint=f"Known: {', '.join((*_SB3, *_CONTRIB, *AGENTS))}.")


def _read_vecnormalize(path: Path, policy: Any) -> ObsNormalizer | None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from sb3_dce.envs import SpacesEnv

    env = DummyVecEnv([lambda: SpacesEnv(policy.observation_space, policy.action_space)])
    try:
        statistics = VecNormalize.load(str(path), env)
    except FileNotFoundError:
        raise CheckpointError(
            "no such file", where=str(path), path=path, hint="Give the file written by VecNormalize.save()."
        ) from None
    except Exception as error:  # whatever the pickle does
        raise CheckpointError(
            f"no VecNormalize statistics of this policy ({type(error).__name__}: {error})",
            where=str(path),
            path=path,
            hint="Give the file that env.save() wrote beside the model.",
        ) from error
    if not statistics.norm_obs:
        return None
    rms: Any = statistics.obs_rms
    return ObsNormalizer(rms.mean, np.sqrt(rms.var + statistics.epsilon), float(statistics.clip_obs))


def _check_fit(policy: NumpyPolicy, path: Path, observation_space: spaces.Box, action_space: spaces.Box) -> None:
    widths = (policy.obs_dim, policy.act_dim)
    wanted = (observation_space.shape[0], action_space.shape[0])
    if widths != wanted:
        raise ConfigError(
            f"the policy takes {widths[0]} observations and gives {widths[1]} actions, the environment has {wanted[0]} and "
            f"{wanted[1]}",
            where=str(path),
            path=path,
            key="policy",
            hint="Name the environment the policy was trained in.",
        )
    if not (np.array_equal(policy.low, action_space.low) and np.array_equal(policy.high, action_space.high)):
        raise ConfigError(
            f"the policy acts in [{policy.low}, {policy.high}], the environment in [{action_space.low}, {action_space.high}]",
            where=str(path),
            path=path,
            key="policy",
            hint="Name the environment the policy was trained in.",
        )
