"""How files state gravity: the mounting, a payload, and masses of links, with units in the keys."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import Length, Mass, Table
from rpim_opt.robot.gravity import MOUNTINGS, Gravity

Mounting = str | list[Annotated[float, Field(strict=False)]]
"""``"floor"``, ``"ceiling"``, ``"wall"``, or where gravity points in the robot's base."""


class PayloadTable(Table):
    """What the flange carries: ``[payload]``."""

    mass: Mass
    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0


def stated_gravity(
    gravity: Gravity,
    mounting: Mounting | None,
    payload: PayloadTable | None,
    file: object,
    base: Array | None = None,
) -> Gravity:
    """Return a robot's gravity with the mounting and the payload that a file states.

    Parameters
    ----------
    gravity
        What holds where the file states nothing.
    mounting, payload
        Of the file.
    file
        What an error names.
    base
        (3, 3) rotation of frame 0 of the table in the base that the mounting speaks of.
    """
    try:
        if mounting is not None:
            gravity = gravity.mounted(mounting, base)
        if payload is not None:
            gravity = gravity.carrying(payload.mass, (payload.x, payload.y, payload.z))
    except InputError as error:
        raise InputError(f"key {error.where}", error.found, error.accepted, file) from None
    return gravity


def of_links(gravity: Gravity, masses: list[float | None], centres: list[tuple[float, ...]], file: object) -> Gravity:
    """Return gravity with the masses of the links that state one; others weigh nothing. Without any, the guess."""
    if all(mass is None for mass in masses):
        return gravity
    try:
        return Gravity(
            gravity.direction,
            tuple(mass or 0.0 for mass in masses),
            tuple((x, y, z) for x, y, z in centres),
            gravity.payload,
            gravity.payload_centre,
        )
    except InputError as error:
        raise error.within(file) from None


def mounting_keys(gravity: Gravity) -> dict[str, Any]:
    """Return the keys that state where gravity points, none for a robot on the floor."""
    words = {direction: word for word, direction in MOUNTINGS.items()}
    if gravity.direction == MOUNTINGS["floor"]:
        return {}
    return {"mounting": words.get(gravity.direction, list(gravity.direction))}


def payload_keys(gravity: Gravity) -> dict[str, Any]:
    """Return the keys of ``[payload]``, none where nothing is carried."""
    if not gravity.payload and not np.any(gravity.payload_centre):
        return {}
    return {"mass_kg": gravity.payload} | centre_keys(gravity.payload_centre, "")


def centre_keys(centre: tuple[float, ...], prefix: str) -> dict[str, float]:
    """Return the keys of a centre of mass: millimetres where that loses no bit, metres elsewhere."""
    keys = {}
    for axis, value in zip("xyz", centre, strict=True):
        if value:
            mm = float(f"{1e3 * value:.15g}")
            unit, number = ("mm", mm) if 1e-3 * mm == value else ("m", value)
            keys[f"{prefix}{axis}_{unit}"] = number
    return keys
