"""
Offline reinforcement learning for people who know Stable-Baselines3.

Importing the package registers the dataset ids as Gymnasium environments. The agents, and with them PyTorch and
Stable-Baselines3, are imported when they are first asked for, so that the command line answers at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sb3_dce.data import Transitions, load_dataset, load_transitions
from sb3_dce.data.catalog import normalized_score
from sb3_dce.envs import register_envs

if TYPE_CHECKING:
    from sb3_dce.bc import OfflineBC
    from sb3_dce.cql import OfflineCQL
    from sb3_dce.dce import OfflineDCE
    from sb3_dce.dce_variants import OfflineCQLEq18, OfflineSACV
    from sb3_dce.iql import OfflineIQL
    from sb3_dce.pbrl import OfflinePBRL
    from sb3_dce.sac import OfflineSAC
    from sb3_dce.td3_bc import OfflineTD3BC
    from sb3_dce.uwac import OfflineUWAC

__version__ = "0.1.0"

_AGENTS = {
    "OfflineBC": "sb3_dce.bc",
    "OfflineCQL": "sb3_dce.cql",
    "OfflineCQLEq18": "sb3_dce.dce_variants",
    "OfflineDCE": "sb3_dce.dce",
    "OfflineIQL": "sb3_dce.iql",
    "OfflinePBRL": "sb3_dce.pbrl",
    "OfflineSAC": "sb3_dce.sac",
    "OfflineSACV": "sb3_dce.dce_variants",
    "OfflineTD3BC": "sb3_dce.td3_bc",
    "OfflineUWAC": "sb3_dce.uwac",
}

__all__ = [
    "OfflineBC",
    "OfflineCQL",
    "OfflineCQLEq18",
    "OfflineDCE",
    "OfflineIQL",
    "OfflinePBRL",
    "OfflineSAC",
    "OfflineSACV",
    "OfflineTD3BC",
    "OfflineUWAC",
    "Transitions",
    "__version__",
    "load_dataset",
    "load_transitions",
    "normalized_score",
    "register_envs",
]


def __getattr__(name: str) -> Any:
    if name in _AGENTS:
        return getattr(importlib.import_module(_AGENTS[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
