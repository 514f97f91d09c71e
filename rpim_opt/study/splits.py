"""What is fitted and what is held out, by whole configurations: as the folder says, a part at random, or folds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.store.instances import Instance

FOLDER = "folder"
MOST_FOLDS = 10_000
"""Each is a calibration of its own, and is listed before the first begins."""
NOISE = 11
"""Stream of the noise that is added, apart from those that draw configurations."""


@dataclass(frozen=True)
class Split:
    """A way to hold configurations out.

    Parameters
    ----------
    label
        What rows call it.
    part
        What part of the configurations is held out at random; zero otherwise.
    folds
        In how many folds each is held out once; one for no folds.
    """

    label: str
    part: float = 0.0
    folds: int = 1

    @property
    def by_seed(self) -> bool:
        """Whether another seed holds others out."""
        return self.label != FOLDER

    def held(self, data: Dataset, fold: int, seed: int) -> np.ndarray:
        """Return which rows (N,) are held out; all rows of a configuration are, or none."""
        known = np.unique(data.configuration)
        drawn = np.random.default_rng(seed).permutation(known)
        if self.part:
            count = min(max(round(self.part * len(known)), 1), len(known) - 1)
            return np.isin(data.configuration, drawn[:count])
        if len(known) < self.folds:
            found = f"{len(known)} configurations"
            raise InputError("splits", found, f"at least {self.folds} for {self.folds} folds")
        return np.isin(data.configuration, np.array_split(drawn, self.folds)[fold - 1])


def splits_of(stated: Any) -> tuple[Split, ...]:
    """Return what ``splits`` says: ``"folder"``, a part (0.25), a number of folds (5), or several of them.

    Raises
    ------
    InputError
        For anything else.
    """
    if isinstance(stated, Sequence) and not isinstance(stated, str):
        found = tuple(dict.fromkeys(_split(each) for each in stated))
        if found:
            return found
    return (_split(stated),)


def _split(stated: Any) -> Split:
    number = isinstance(stated, int | float) and not isinstance(stated, bool)
    if stated == FOLDER:
        return Split(FOLDER)
    if number and 0 < stated < 1:
        return Split(f"{stated:g} held out", part=float(stated))
    if number and 2 <= stated <= MOST_FOLDS and stated == int(stated):
        return Split(f"{int(stated)} folds", folds=int(stated))
    accepted = f"'folder', a part of the configurations between 0 and 1, or a number of folds, 2 to {MOST_FOLDS}"
    raise InputError("splits", f"{stated!r}", accepted)


def divided(
    instance: Instance, split: Split, fold: int, count: int | None, noise: float, seed: int
) -> tuple[Instance, Dataset]:
    """Return an instance with the data to fit, and the data that are held out.

    Parameters
    ----------
    instance
        The problem; its validation data are used by the split ``"folder"`` and by no other.
    split, fold
        What is held out; folds count from 1.
    count
        How many of the configurations that are left are fitted, drawn at random; None for all.
    noise
        By what the noise of the data to fit is larger than it was measured with.
    seed
        Of everything that is drawn.

    Raises
    ------
    InputError
        For fewer configurations than asked, or nothing that is held out.
    """
    data = instance.problem.data
    if split.label == FOLDER:
        if instance.validation is None:
            raise InputError("splits", "no validation data", "a folder with some, a part (0.25), or folds (5)")
        held_out = instance.validation
    else:
        held = split.held(data, fold, seed)
        held_out = data.take(np.flatnonzero(held))
        data = data.take(np.flatnonzero(~held))
    if count is not None:
        data = data.configurations(count, seed)
    if noise > 1:
        data = noisier(data, noise, seed)
    return replace(instance, problem=instance.problem.on(data), validation=held_out), held_out


def noisier(data: Dataset, factor: float, seed: int) -> Dataset:
    """Return data with as much normal noise added that it is ``factor`` times what it was, and declared so.

    To a row of covariance S comes noise of covariance (factor^2 - 1) S; it then declares factor^2 S.
    """
    rng = np.random.default_rng([seed, NOISE])
    return replace(data, blocks=tuple(_noisier(block, factor, rng) for block in data.blocks))


def _noisier(block: Block, factor: float, rng: np.random.Generator) -> Block:
    k = block.covariance.shape[1]
    root = np.sqrt(factor**2 - 1) * np.linalg.cholesky(block.covariance)
    error = (root @ rng.standard_normal((len(block.y), k, 1)))[:, :, 0]
    return replace(block, y=block.measurement.plus(block.y, error), covariance=factor**2 * block.covariance)
