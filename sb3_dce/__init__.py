"""Offline reinforcement learning for people who know Stable-Baselines3."""

__version__ = "0.1.0"

from sb3_dce.data import Transitions, load_transitions  # noqa: E402
from sb3_dce.data.catalog import normalized_score  # noqa: E402
from sb3_dce.dce import OfflineDCE  # noqa: E402
from sb3_dce.envs import register_envs  # noqa: E402

register_envs()

__all__ = ["OfflineDCE", "Transitions", "__version__", "load_transitions", "normalized_score", "register_envs"]
