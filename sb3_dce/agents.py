"""The agents by the names they have in hyperparameter files, on the command line and in rl_zoo3."""

from __future__ import annotations

from sb3_dce.base import OfflineAlgorithm
from sb3_dce.bc import OfflineBC
from sb3_dce.checks import did_you_mean
from sb3_dce.cql import OfflineCQL
from sb3_dce.dce import OfflineDCE
from sb3_dce.dce_probe import OfflineDCEProbe
from sb3_dce.dce_variants import OfflineCQLEq18, OfflineSACV
from sb3_dce.errors import ConfigError
from sb3_dce.iql import OfflineIQL
from sb3_dce.pbrl import OfflinePBRL
from sb3_dce.sac import OfflineSAC
from sb3_dce.td3_bc import OfflineTD3BC
from sb3_dce.uwac import OfflineUWAC

_CLASSES: tuple[type[OfflineAlgorithm], ...] = (
    OfflineDCE,
    OfflineBC,
    OfflineTD3BC,
    OfflineIQL,
    OfflineSAC,
    OfflineSACV,
    OfflineCQLEq18,
    OfflineCQL,
    OfflinePBRL,
    OfflineUWAC,
)
AGENTS: dict[str, type[OfflineAlgorithm]] = {agent.algo_name: agent for agent in _CLASSES}
# Trained, saved and loaded like agents, but measuring instruments: not offered for a choice.
PROBES: dict[str, type[OfflineAlgorithm]] = {OfflineDCEProbe.algo_name: OfflineDCEProbe}


def agent_class(algo: str) -> type[OfflineAlgorithm]:
    """
    Class that an agent's name stands for; a probe is found too, but is not among the names that an error offers.

    :param algo: name such as ``dce`` or ``offline_bc``
    :return: class of the agent
    :raises ConfigError: for an unknown name
    """
    if algo in PROBES:
        return PROBES[algo]
    if algo not in AGENTS:
        raise ConfigError(
            f"unknown algorithm {algo!r}", key="algo", hint=f"{did_you_mean(algo, AGENTS)}Known: {', '.join(AGENTS)}."
        )
    return AGENTS[algo]
