"""Repeatability of the robot in addition to measurement noise, shared by all equations of a configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import three_digits
from rpim_opt.data.dataset import Dataset

UNITS = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3), "pixel": ("px", 1.0)}
"""Unit in which residuals and their standard deviations are reported, and its value in SI."""


def in_unit(error: float | None, dimension: str) -> str:
    """Return an error [SI] with its unit; an empty text for None."""
    unit, si = UNITS[dimension]
    return "" if error is None else f"{three_digits(error / si)} {unit}"


@dataclass(frozen=True, eq=False)
class Repeatability:
    """Repeatability of a robot: standard deviations of positions, orientations and joints about its model.

    The covariance of all readings of one configuration is::

        instrument^2 Sigma + reading^2 I_length + position^2 J_p J_p' + orientation^2 I_angle
        + joint^2 J_theta J_theta'

    with Sigma as stated by the rows, J_p (k, 3) the derivatives by the robot's place and J_theta (k, dof) those by the
    angles of the revolute joints: an error in position displaces all reflectors of a configuration alike, that of a
    joint in proportion to the lever arm.

    ``position`` [m] is the standard deviation of every coordinate of the robot's place and ``orientation`` [rad] that
    of every measured angle, both without the joints' part, ``joint`` [rad] that of every revolute joint, and
    ``reading`` [m] that of every measured length by itself, as by seats of reflectors and returns of the robot: only
    configurations with several readings tell it from ``position``. ``instrument`` multiplies the stated noise. ``at``
    (P,) are the values of all parameters at which the derivatives are taken [SI], nominal if None.
    """

    position: float = 0.0
    orientation: float = 0.0
    joint: float = 0.0
    instrument: float = 1.0
    reading: float = 0.0
    at: Array | None = None


@dataclass(frozen=True, eq=False)
class Stack:
    """Configurations with the same number k of equations: the components of their noise, one array each.

    ``index`` (N, k) are numbers of the equations; ``instrument`` (N, k, k) is the covariance stated by the rows [SI];
    ``length`` and ``angle`` (N, k) mark lengths and angles; ``joint`` (N, k, dof) are derivatives by the revolute
    joints' angles [SI], dof columns per stop of the joints, or none; ``unit`` (N, k, k), or None for every length by
    itself, is the covariance for unit variance of every position if readings share it, or equations mix several.
    """

    index: np.ndarray
    instrument: Array
    length: np.ndarray
    angle: np.ndarray
    joint: Array
    unit: Array | None = None

    def of(self, dimension: str) -> np.ndarray:
        """Return which equations (N, k) are of a dimension: ``length``, ``angle``, or any other."""
        others = ~(self.length | self.angle)
        return {"length": self.length, "angle": self.angle}.get(dimension, others)

    def covariance(self, repeatability: Repeatability, reading: bool = True) -> Array:
        """Return the covariances (N, k, k) [SI] of the residuals; without the instrument's part if not of a reading."""
        k = self.index.shape[1]
        of_length = repeatability.reading**2 + repeatability.position**2 * (self.unit is None)
        own = of_length * self.length + repeatability.orientation**2 * self.angle
        covariance = own[:, :, None] * np.eye(k)
        if self.unit is not None:
            covariance += repeatability.position**2 * self.unit
        if repeatability.joint > 0:
            covariance += repeatability.joint**2 * self.joint @ self.joint.transpose(0, 2, 1)
        if reading:
            covariance += repeatability.instrument**2 * self.instrument
        return covariance


def equation_numbers(data: Dataset) -> list[np.ndarray]:
    """Return the numbers (N, k) of the equations of every block's rows."""
    shapes = [(len(block.row), len(block.measurement.components)) for block in data.blocks]
    first = np.cumsum([0, *(rows * k for rows, k in shapes)])
    return [start + np.arange(rows * k).reshape(rows, k) for start, (rows, k) in zip(first, shapes, strict=False)]


class Equations(NamedTuple):
    """The equations (m,): row, component of it, kind, and the covariance (m, K) with the components of their row."""

    row: np.ndarray
    component: np.ndarray
    length: np.ndarray
    angle: np.ndarray
    covariance: Array

    @classmethod
    def of(cls, data: Dataset) -> Equations:
        """Return the equations in the order of the data's blocks."""
        widest = max(len(block.measurement.components) for block in data.blocks)
        parts = []
        for block in data.blocks:
            N = len(block.row)
            dimensions = np.array(list(block.measurement.components.values()))
            k = len(dimensions)
            V = np.zeros((N, k, widest))
            V[:, :, :k] = block.covariance
            kinds = [np.tile(dimensions == dimension, N) for dimension in ("length", "angle")]
            parts.append((np.repeat(block.row, k), np.tile(np.arange(k), N), *kinds, V.reshape(-1, widest)))
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def stack(self, index: np.ndarray, slopes: Array | None = None, shifts: Array | None = None) -> Stack:
        """Return the noise of equations (N, k), from their slopes (m, dof) by joints, and (m, 3) by the robot's place.

        Lengths that do not depend on the place, as between two robots, vary by themselves.
        """
        row = self.row[index]
        V = self.covariance[index[:, :, None], self.component[index][:, None, :]]
        V = V * (row[:, :, None] == row[:, None, :])
        length = self.length[index]
        joint = np.zeros((*index.shape, 0)) if slopes is None else slopes[index]
        unit = None
        if shifts is not None:
            G = shifts[index]
            own = length & ~G.any(axis=2)
            unit = G @ G.transpose(0, 2, 1) + own[:, :, None] * np.eye(index.shape[1])
        return Stack(index, V, length, self.angle[index], joint, unit)

    def grouped(self, number: np.ndarray) -> list[np.ndarray]:
        """Return the equations (N, k) of every k that groups have, by the number (m,) of their group, row by row."""
        order = np.lexsort((self.row, number))
        _, first, count = np.unique(number[order], return_index=True, return_counts=True)
        return [order[first[count == k][:, None] + np.arange(k)] for k in np.unique(count)]
