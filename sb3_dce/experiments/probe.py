"""
The probe of out-of-distribution actions as a run like any other: it begins from a checkpoint that holds the "best policy".

The paper's "pre-trained best policy" is here the last policy of the DCE run of the same data and seed: no checkpoint is
chosen by evaluating it online.
"""

from __future__ import annotations

from pathlib import Path

from sb3_dce.dce import OfflineDCE
from sb3_dce.dce_probe import OfflineDCEProbe
from sb3_dce.errors import ConfigError
from sb3_dce.run_files import RunSpec


def prepare_probe(spec: RunSpec, best_policy: Path) -> None:
    """
    Write the checkpoint at update 0 from which the probe's run begins; one that has begun is left alone.

    :param spec: run of the probe
    :param best_policy: folder of the complete DCE run
    :raises ConfigError: if that run has no model
    """
    folder = Path(spec.folder)
    if any((folder / name).is_file() for name in ("checkpoint.zip", "model.zip")):
        return
    trained = best_policy / "model.zip"
    if not trained.is_file():
        raise ConfigError(
            "the probe needs the last policy of the DCE run, which has no model here",
            where=str(best_policy),
            hint="It may have diverged, or only its rows may be known; delete the folder and its rows to train it again.",
        )
    probe = OfflineDCEProbe.load_dataset(spec.dataset, seed=spec.seed, **spec.overrides)
    probe.set_best_policy(OfflineDCE.load(trained, device=probe.device))
    probe.num_timesteps = 0
    folder.mkdir(parents=True, exist_ok=True)
    probe.save(folder / "checkpoint.zip")
