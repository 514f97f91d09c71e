"""A table of a simulated camera: configurations in which it sees its whole board, and where every point appears."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import joint_columns
from rpim_opt.data.board import on_board
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import Measurement
from rpim_opt.data.reading import read_data
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.sight import postures_in_sight
from rpim_opt.robot.parameters import Parameters
from rpim_opt.store.problem_file import Stated


class Plan(Protocol):
    """What is simulated of a camera."""

    @property
    def joint_share(self) -> float:
        """Part of every joint's range."""
        ...

    @property
    def image_px(self) -> list[int]:
        """Width and height of the image."""
        ...


def seen_table(
    stated: Stated,
    kind: Measurement,
    parameters: Parameters,
    x: Array,
    plan: Plan,
    count: int,
    noise: Mapping[str, Any],
    rng: np.random.Generator,
    noisy: bool,
) -> dict[str, list[str]]:
    """Return the columns of a table as text.

    Parameters
    ----------
    stated, kind
        The problem and the measurement.
    parameters, x
        The world: parameters and their true deviations (n,) [SI].
    plan, count
        How it is simulated, and how many views there are.
    noise
        What the table states of its noise.
    rng
        The draws.
    noisy
        Whether pixels have noise.

    Raises
    ------
    InputError
        Without a target, and where the board is hardly ever in sight.
    """
    if stated.board is None:
        raise InputError("key target", "nothing", "the points of the board that the camera sees", stated.path)
    names = list(stated.board)
    points = np.array([stated.board[name] for name in names])
    units = joint_columns(stated.robot.joint_dimensions)
    one = {"point": names[:1], "u_px": ["0"], "v_px": ["0"], **{name: ["0"] for name in units}}
    world = CalibrationProblem(stated.robot, parameters, _read(stated, kind, one, noise))
    width, height = _size(plan.image_px, stated)
    q = postures_in_sight(world, points, count, rng, x, plan.joint_share, (width, height))
    table: dict[str, list[str]] = {
        "label": [f"v{k}/{name}" for k in range(count) for name in names],
        "point": names * count,
    }
    for (name, si), column in zip(units.items(), q.T, strict=True):
        table[name] = [f"{v:.5f}" for v in np.repeat(column / si, len(names))]
    empty = {"u_px": ["0"] * len(table["label"]), "v_px": ["0"] * len(table["label"])}
    data = _read(stated, kind, {**table, **empty}, noise)
    exact = world.on(data).modelled(x)[0]
    covariance = np.broadcast_to(data.blocks[0].covariance, (len(exact), 2, 2))
    e = (np.linalg.cholesky(covariance) @ rng.normal(size=(len(exact), 2, 1)))[:, :, 0]
    y = exact + noisy * e
    return {**table, "u_px": [f"{u:.4f}" for u in y[:, 0]], "v_px": [f"{v:.4f}" for v in y[:, 1]]}


def _read(stated: Stated, kind: Measurement, table: Mapping[str, list[str]], noise: Mapping[str, Any]) -> Dataset:
    return read_data(on_board(dict(table), stated.board or {}), stated.robot, noise, kind)


def _size(image: list[int], stated: Stated) -> tuple[int, int]:
    if len(image) != 2 or min(image) < 1:
        raise InputError("key simulation.image_px", f"{image}", "width and height", stated.path)
    return image[0], image[1]
