"""Offline reinforcement learning for people who know Stable-Baselines3."""

from sb3_dce.bc import OfflineBC
from sb3_dce.data import Transitions, load_transitions
from sb3_dce.data.catalog import normalized_score
from sb3_dce.dce import OfflineDCE
from sb3_dce.envs import register_envs

__version__ = "0.1.0"

__all__ = [
    "OfflineBC",
    "OfflineDCE",
    "Transitions",
    "__version__",
    "load_transitions",
    "normalized_score",
    "register_envs",
]
