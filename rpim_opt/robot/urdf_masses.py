"""The masses that a URDF states, by the moving joint of a chain that carries them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.robot.chain import link_of
from rpim_opt.robot.gravity import Vector
from rpim_opt.robot.urdf_tree import Element, Joint, Urdf, floats


def carried_masses(urdf: Urdf, chain: Sequence[Joint]) -> tuple[tuple[float, ...], tuple[Array, ...]]:
    """Return the mass [kg] that each moving joint of a chain carries up to the next, and its centre [m].

    Links beside the chain and beyond its tip, a gripper's for instance, hang where their joints are at zero. What
    cannot be read beside the chain is left out, as it is elsewhere.

    Returns
    -------
    n masses, and n centres (3,) in the frames of the file's joints; none of both where nothing that moves has a mass.
    """
    frames = _frames(chain)
    count = max(i for i, _ in frames.values())
    masses = np.zeros(count)
    moments = np.zeros((count, 3))
    for name, body in urdf.bodies.items():
        held = _held(urdf, name, frames)
        mass, centre = _inertial(urdf, name, body, name in frames)
        if held is None or not mass:
            continue
        i, T = held
        if i:
            masses[i - 1] += mass
            moments[i - 1] += mass * (T[:3, :3] @ centre + T[:3, 3])
    if not masses.any():
        return (), ()
    weighty = np.where(masses > 0, masses, 1.0)
    return tuple(masses.tolist()), tuple(moments / weighty[:, None])


def on_frames(centres: Sequence[Array], table: Array, G: Array) -> tuple[Vector, ...]:
    """Return centres in the frames after the table's links, with what ties the file's to them (`chain.describe`)."""
    if not centres:
        return ()
    found = []
    for centre, row, g in zip(centres, table, G, strict=True):
        T = link_of(beta=-row[4]) @ g
        x, y, z = (T[:3, :3] @ centre + T[:3, 3]).tolist()
        found.append((x, y, z))
    return tuple(found)


def _frames(chain: Sequence[Joint]) -> dict[str, tuple[int, Array]]:
    """Return for the links of a chain which moving joint (from 1; 0: none) carries them, and where they are on it."""
    frames = {chain[0].parent: (0, np.eye(4))}
    for joint in chain:
        i, T = frames[joint.parent]
        if joint.kind:
            frames[joint.child] = (i + 1, np.eye(4))
        else:
            frames[joint.child] = (i, T @ joint.origin)
    return frames


def _held(urdf: Urdf, name: str, frames: dict[str, tuple[int, Array]]) -> tuple[int, Array] | None:
    """Return by which joint a link of the file is carried, and where it is on it; None for what is above the base."""
    T = np.eye(4)
    while name not in frames:
        joint = urdf.above.get(name)
        if joint is None:
            return None
        try:
            T = joint.origin @ T
        except InputError:
            return None
        name = joint.parent
    i, start = frames[name]
    return i, start @ T


def _inertial(urdf: Urdf, name: str, body: Element, required: bool) -> tuple[float, Array]:
    """Return the mass [kg] of a link and its centre (3,) in the link's frame [m]; no mass where none is stated."""
    none = 0.0, np.zeros(3)
    inertial = [e for e in body.children if e.tag == "inertial"]
    if not inertial:
        return none
    stated = {e.tag: e.attributes for e in inertial[0].children}
    try:
        mass = floats(stated.get("mass", {}).get("value", "0"), 1)[0]
        centre = floats(stated.get("origin", {}).get("xyz", "0 0 0"), 3)
        if mass < 0:
            raise ValueError
    except ValueError:
        if not required:
            return none
        found = f"mass {stated.get('mass')}, origin {stated.get('origin')}"
        accepted = "a mass that is not negative, and three finite numbers"
        raise InputError(f"link '{name}', inertial", found[:80], accepted, urdf.path) from None
    return float(mass), centre
