"""
Are two datasets the same numbers, or at least two samples of the same thing?

A simulation made again on another machine differs in the last bits, and then, since a contact amplifies them, in whole
episodes. So what can be asked of data made anew is whether its episodes could come from the same distribution.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from os import PathLike
from pathlib import Path
from statistics import NormalDist

import numpy as np

from sb3_dce.data.hashes import content_hash
from sb3_dce.data.layout import CORE_KEYS
from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import DatasetFormatError, DatasetNotFoundError, DatasetSemanticsError
from sb3_dce.files import write_text
from sb3_dce.student import student_quantile, welch_freedom

IDENTICAL, ALIKE, DIFFERENT = "identical", "statistically equal", "different"
# Probability that some quantity of two samples of the same thing is called different: that of three standard errors.
FAMILY_ERROR = 2 * NormalDist().cdf(-3.0)
MIN_EPISODES = 10


@dataclass(frozen=True)
class DatasetCard:
    """
    What a comparison needs to know about a dataset, small enough to be committed beside results.

    Each quantity has one value per whole episode: its return, its length, and the mean and the standard deviation of every
    entry of its observations and actions.

    :param id: id of the dataset
    :param rows: transitions
    :param episodes: whole episodes
    :param content_hash: SHA-256 of the transitions, independent of format and compression
    :param sha256: hash of the file, as results name it; None for arrays
    :param means: quantity to its mean over the episodes, in the units of the data
    :param stds: quantity to its standard deviation over the episodes, with divisor n
    """

    id: str
    rows: int
    episodes: int
    content_hash: str
    sha256: str | None
    means: dict[str, float]
    stds: dict[str, float]

    @classmethod
    def of(cls, transitions: Transitions) -> DatasetCard:
        """
        Make the card of a dataset; without a whole episode its means and standard deviations are empty.

        :param transitions: dataset
        :return: its card
        """
        info = transitions.info
        values = dict(_per_episode(transitions)) if len(info.episode_numbers) else {}
        n_episodes = len(values["return"]) if values else 0
        return cls(
            id=info.id,
            rows=len(transitions),
            episodes=n_episodes,
            content_hash=content_hash({key: getattr(transitions, key) for key in CORE_KEYS}),
            sha256=info.sha256,
            means={name: float(value.mean()) for name, value in values.items()},
            stds={name: float(value.std()) for name, value in values.items()},
        )

    @classmethod
    def read(cls, path: str | PathLike[str]) -> DatasetCard:
        """
        Read a card, after checking that its quantities are numbers and that each has a mean and a standard deviation.

        :param path: file of :meth:`write`
        :return: the card
        :raises DatasetNotFoundError: if there is no such file
        :raises DatasetFormatError: if it is no card
        """
        hint = "sb3-dce datasets info <dataset> --card <file> writes one"
        if not Path(path).is_file():
            raise DatasetNotFoundError("there is no such file", where=str(path), hint=hint)
        try:
            card = cls(**json.loads(Path(path).read_bytes()))
            numbers = [*card.means.values(), *card.stds.values(), card.rows, card.episodes]
            if card.means.keys() != card.stds.keys() or not all(type(number) in (int, float) for number in numbers):
                raise ValueError
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise DatasetFormatError(
                f"this is no card of a dataset (JSON with {', '.join(f.name for f in fields(cls))})",
                where=str(path),
                hint=hint,
            ) from error
        return card

    def write(self, path: str | PathLike[str]) -> None:
        """
        Write the card as JSON for :meth:`read`; an existing file is replaced only when the new one is complete.

        :param path: file to write
        :raises CheckpointError: if it cannot be written
        """
        write_text(Path(path), json.dumps(asdict(self), indent=1) + "\n")


@dataclass(frozen=True)
class Comparison:
    """
    What :func:`compare_datasets` says of two datasets; ``n_quantities`` and ``limit`` are 0 where none was compared.

    :param verdict: ``identical``, ``statistically equal`` or ``different``
    :param reasons: why they are different, one line a quantity, the farthest first
    :param n_quantities: quantities compared
    :param limit: largest difference that chance explains, in standard errors; of the quantity for which that is most
    """

    verdict: str
    reasons: tuple[str, ...] = ()
    n_quantities: int = 0
    limit: float = 0.0

    def sentence(self) -> str:
        """The verdict for people and, if quantities were compared, how many of them are further apart than the limit."""
        if self.n_quantities == 0:
            return self.verdict
        found = f"{len(self.reasons) or 'none'} of {self.n_quantities} quantities"
        return f"{self.verdict}: {found} further apart than by chance, which explains up to {self.limit:.1f} standard errors"


def compare_datasets(first: DatasetCard, second: DatasetCard) -> Comparison:
    """
    Compare two datasets by their content and, if that differs, by their whole episodes.

    A quantity differs if its means are farther apart than chance explains, by Welch's test (the standard error has the episode
    as its unit: rows of one episode are no independent draws). The limit is Bonferroni's for all quantities together, so two
    samples of one policy are called different about once in 370 times, whatever the number of entries and of episodes.

    :param first: card of one dataset
    :param second: card of the other
    :return: verdict and reasons
    :raises DatasetSemanticsError: if one has too few whole episodes for such a statement
    """
    if first.content_hash == second.content_hash:
        return Comparison(IDENTICAL)
    if first.means.keys() != second.means.keys() and first.means and second.means:
        return Comparison(DIFFERENT, ("their observations or actions have other widths",))
    for card in (first, second):
        if card.episodes < MIN_EPISODES:
            raise DatasetSemanticsError(
                f"{card.episodes} whole episodes are too few to tell chance from a difference",
                where=card.id,
                hint=f"A comparison of data that are not identical needs {MIN_EPISODES} episodes on both sides",
                count=card.episodes,
            )
    level = 1 - FAMILY_ERROR / len(first.means)
    far = sorted(((*_distance(first, second, name, level), name) for name in first.means), reverse=True)
    reasons = tuple(
        f"{name}: {first.means[name]:.6g} and {second.means[name]:.6g}, {distance:.1f} standard errors apart"
        for distance, by_chance, name in far
        if distance > by_chance
    )
    return Comparison(DIFFERENT if reasons else ALIKE, reasons, len(far), max(by_chance for _, by_chance, _ in far))


def _distance(first: DatasetCard, second: DatasetCard, name: str, level: float) -> tuple[float, float]:
    """
    Difference of two means, and that within which chance keeps it with probability ``level``, in standard errors; what never
    varies may differ by rounding only.
    """
    gap = abs(first.means[name] - second.means[name])
    freedoms = [card.episodes - 1 for card in (first, second)]
    errors = [card.stds[name] / freedom**0.5 for card, freedom in zip((first, second), freedoms, strict=True)]
    rounding = 1e-6 * max(abs(first.means[name]), abs(second.means[name]))
    limit = student_quantile(welch_freedom(errors, freedoms) if any(errors) else sum(freedoms), level)
    return (0.0 if gap <= rounding else gap / max(float(np.hypot(*errors)), rounding)), limit


def _per_episode(transitions: Transitions) -> Iterator[tuple[str, np.ndarray]]:
    info, numbers = transitions.info, transitions.episodes
    has_rows = np.isin(info.episode_numbers, numbers)  # an episode of one row may have none whose next observation is known
    yield "return", info.episode_returns[has_rows]
    yield "length", info.episode_lengths[has_rows].astype(float)
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    whole = np.isin(numbers[starts], info.episode_numbers)
    counts = np.diff(starts, append=len(numbers))
    for key in ("observations", "actions"):
        for i, column in enumerate(getattr(transitions, key).T):
            # From the first row on, or the squares of large values swallow the spread.
            shifted = column.astype(np.float64) - float(column[0])
            mean = np.add.reduceat(shifted, starts) / counts
            spread = np.sqrt(np.maximum(np.add.reduceat(shifted**2, starts) / counts - mean**2, 0.0))
            yield f"mean of {key[:-1]} {i}", mean[whole] + float(column[0])
            yield f"spread of {key[:-1]} {i}", spread[whole]
