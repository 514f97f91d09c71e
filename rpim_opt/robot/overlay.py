"""Values that a table gives to parameters: by name, by pattern, or to a whole group."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.patterns import fits
from rpim_opt.basics.units import SMALLEST, quantities, split_unit
from rpim_opt.robot.parameter_names import KNOWN, own_name

PATTERN = re.compile(r"[*?\[]")
JOINT_OFFSET = "joint_offset"
_OFFSET = re.compile(r"theta\d+")


@lru_cache(KNOWN)
def is_joint_offset(name: str) -> bool:
    """Return whether a parameter is the offset of a revolute joint: set at assembly, and not machined."""
    return _OFFSET.fullmatch(own_name(name)) is not None


class Overlay:
    """The parameters that a table may speak of.

    Parameters
    ----------
    names, dimensions, groups
        Of the parameters, one each.
    """

    def __init__(self, names: Sequence[str], dimensions: Sequence[str], groups: Sequence[str]) -> None:
        self.names = names
        self.dimensions = dimensions
        self.groups = groups

    def on(self, values: Array, table: Mapping[str, float], where: str, signed: bool = False) -> Array:
        """Return values (P,) [SI] with those of a table in their places; what names fewer parameters goes before.

        Parameters
        ----------
        values
            (P,) [SI] where the table says nothing.
        table
            Values by name, pattern or group, with units.
        where
            What an error calls the table.
        signed
            Whether zero and negative values are accepted.
        """
        result = values.copy()
        given = quantities(table, self._accepted(table), where)
        for (stem, dimension), value in sorted(given.items(), key=lambda item: self._rank(item[0][0])):
            if not (value >= SMALLEST or signed):
                raise InputError(
                    f"{where}, key {stem}", f"{value:g}", f"a number greater than zero, from {SMALLEST:g} on"
                )
            result[list(self._places(stem, dimension))] = value
        return result

    def _accepted(self, table: Mapping[str, float]) -> dict[str, tuple[str, ...]]:
        """Return what keys may name, with the dimensions that it has: groups, names, and the table's own patterns."""
        stems: dict[str, set[str]] = {}
        for name, group, dimension in zip(self.names, self.groups, self.dimensions, strict=True):
            stems.setdefault(group, set()).add(dimension)
            stems.setdefault(name, set()).add(dimension)
            if is_joint_offset(name):
                stems.setdefault(JOINT_OFFSET, set()).add(dimension)
        for key in filter(PATTERN.search, table):
            stem, _ = split_unit(key)
            met = [d for name, d in zip(self.names, self.dimensions, strict=True) if fits(name, stem)]
            stems.setdefault(stem, set()).update(met)
        return {stem: tuple(sorted(dimensions)) for stem, dimensions in stems.items()}

    def _rank(self, stem: str) -> int:
        """Return the order in which keys are carried out: groups, joint offsets, patterns, names."""
        if stem in self.names:
            return 3
        if PATTERN.search(stem):
            return 2
        return int(stem == JOINT_OFFSET)

    def _places(self, stem: str, dimension: str) -> Iterator[int]:
        for i, name in enumerate(self.names):
            if self.dimensions[i] == dimension and self._meant(stem, i, name):
                yield i

    def _meant(self, stem: str, i: int, name: str) -> bool:
        if stem == JOINT_OFFSET:
            return is_joint_offset(name)
        return stem == self.groups[i] or fits(name, stem)
