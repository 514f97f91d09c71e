"""A table of a simulated camera: configurations in which it sees its whole board, and where every point appears."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import joint_columns
from rpim_opt.data.board import on_board
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import Measurement
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.sight import postures_in_sight
from rpim_opt.store.problem_file import Stated
from rpim_opt.store.simulated_world import Draws, Truth


def seen_table(stated: Stated, kind: Measurement, truth: Truth, count: int, draws: Draws) -> dict[str, list[str]]:
    """Return the columns of a table as text.

    Parameters
    ----------
    stated, kind
        The problem and the measurement.
    truth, count
        The world, and how many views of it there are.
    draws
        How the table is drawn.

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
    one = {"point": names[:1], **{name: ["0"] for name in ("u_px", "v_px", *units)}}
    world = CalibrationProblem(stated.robot, truth.parameters, _read(stated, kind, one, draws))
    plan = truth.plan
    q = postures_in_sight(world, points, count, draws.rng, truth.x, plan.joint_share, _size(plan.image_px, stated))
    table: dict[str, list[str]] = {
        "label": [f"v{k}/{name}" for k in range(count) for name in names],
        "point": names * count,
    }
    for (name, si), column in zip(units.items(), q.T, strict=True):
        table[name] = [f"{v:.5f}" for v in np.repeat(column / si, len(names))]
    empty = {name: ["0"] * len(table["label"]) for name in ("u_px", "v_px")}
    data = _read(stated, kind, {**table, **empty}, draws)
    y = world.on(data).modelled(truth.x)[0] + draws.errors(data.blocks[0])
    return {**table, "u_px": [f"{u:.4f}" for u in y[:, 0]], "v_px": [f"{v:.4f}" for v in y[:, 1]]}


def _read(stated: Stated, kind: Measurement, table: Mapping[str, list[str]], draws: Draws) -> Dataset:
    return read_data(on_board(dict(table), stated.board or {}), stated.robot, draws.noise, kind)


def _size(image: list[int], stated: Stated) -> tuple[int, int]:
    if len(image) != 2 or min(image) < 1:
        raise InputError("key simulation.image_px", f"{image}", "width and height", stated.path)
    return image[0], image[1]
