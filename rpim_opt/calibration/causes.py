"""Likely causes of a poor fit: input mistakes that are tested when residuals are too large."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import cast

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import three_digits
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.verdict import BAD, NOISY, kept_rows, noise_ratio, residuals, rms
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem import diagnosis
from rpim_opt.problem.diagnosis import first
from rpim_opt.problem.misreadings import Better, better_reading
from rpim_opt.problem.noise import UNITS
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import settled

HOPELESS = 20.0
"""Residuals over the stated noise from which something is said even if nothing explains them."""
SCALES = 10.0
"""Scales by which a parameter of the robot may deviate."""
LARGEST_CURVE = 0.01
"""Standard deviation of transmission errors [rad] that no gear exceeds: real ones are below a milliradian."""
LARGEST = {"length": 0.02, "angle": 0.05}
"""A machined and assembled robot deviates by less than this [m, rad]."""

NOTHING = (
    "None of the tested input mistakes explains it. Check the nominal parameters; the arm may be compliant,"
    " or less repeatable than stated. See rpim-opt inspect."
)


def likely_causes(result: Outcome) -> list[str]:
    """Return the likely causes of a poor fit, one sentence each; empty if the fit is good.

    A fit is bad if it did not converge, leaves residuals of `NOISY` times the instrument's stated noise in rows that it
    does not downweight, or deviates by many scales. Then the table is read in other ways (`better_reading`), and rows
    without value, exchanged rows, rounded joints and a base that moved are looked for. A calibration of data in blocks
    says nothing.

    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> ro.calibration.likely_causes(ro.calibrate(problem, ro.tikhonov, weight=1.0))
    []
    >>> block = problem.data.blocks[0]
    >>> wrong = replace(block, q=block.q[:, :, [0, 2, 1, 3, 4, 5]])
    >>> result = ro.calibrate(problem.on(replace(problem.data, blocks=(wrong,))), ro.tikhonov, weight=1.0)
    >>> causes = ro.calibration.likely_causes(result)
    >>> causes[1].partition(" with ")[2]
    'joints 2 and 3 exchanged: exchange the names of the columns q2 and q3.'
    """
    if not result.problem.keeps_rows:
        return []
    problem = cast(CalibrationProblem, result.problem)
    learned, free = result.learned, problem.parameters.free
    shared = [*diagnosis.shared_rows(problem.data, result.record.validation), *diagnosis.copied_rows(problem.data)]
    if learned is not None:
        shared += diagnosis.left_out_together(problem.labels, {row.label for row in learned.left_out})
    if result.mapping is not None:
        shared += result.mapping.ambiguities
    kept = kept_rows(result)
    sizes = residuals(result, kept)
    signs = []
    for dimension, (size, ratio) in sizes.items():
        unit, si = UNITS[dimension]
        if ratio > NOISY:
            signs.append(f"residual RMS {three_digits(size / si)} {unit}, {three_digits(ratio)} times the stated noise")
    if learned is not None and learned.curves is not None:  # beyond those of gears, or no transmission errors at all
        size, ratio = learned.curves.size.value, result.noise_test().ratio
        if size > LARGEST_CURVE:
            signs.append(f"transmission errors of {three_digits(1e3 * size)} mrad (1 sigma)")
        if ratio > NOISY:
            noise = f"{three_digits(ratio)} times the stated noise"
            signs.append(f"residuals {noise}, including the degrees of freedom of transmission errors")
    # no nominal model is as wrong as that; an estimated scale is not the expected one
    expected = free.scale if learned is None else learned.stated
    largest = np.array([LARGEST.get(dimension, np.inf) for dimension in free.dimensions])
    share = np.abs(result.x) / np.maximum(largest, SCALES * expected)
    share[problem.parameters.of_frames[problem.parameters.identified]] = 0.0
    worst = int(np.argmax(share))
    if share[worst] > 1:
        unit = "mm" if free.dimensions[worst] == "length" else "mrad"
        signs.append(f"{free.names[worst]} deviates by {three_digits(1e3 * result.x[worst])} {unit}")
    head: list[str] = []
    causes: list[str] = []
    if signs:
        head = [f"{BAD}: {'; '.join(signs)}."]
    if signs or not result.converged:
        causes = [*_found(result, problem), *diagnosis.computed_columns(problem)]
    elif not kept.all():
        causes = [*diagnosis.rows_without_values(problem), *diagnosis.exchanged_rows(problem)]
    if causes or shared:
        return [*head, *(f"Likely: {cause}" for cause in causes), *shared]
    if max(ratio for _, ratio in sizes.values()) > HOPELESS:
        return [*head, NOTHING]
    return []


def _found(result: Outcome, problem: CalibrationProblem) -> list[str]:
    """Return what explains the fit of a calibration that is judged bad: something of all rows, else of some."""
    if len(problem.arms) > 1:  # a table is read anew with the nominal model of one robot
        return list(diagnosis.rows_without_values(problem))
    ordered = _in_table_order(result, problem)
    better = better_reading(ordered)
    read = list(diagnosis.part_way(ordered)) if better is None else [better.sentence]
    rows = list(diagnosis.rows_without_values(problem))
    if read:
        return [*rows, *read]
    causes = [*rows, *diagnosis.exchanged_rows(problem)]
    causes += first(diagnosis.moved_far(problem), diagnosis.mixed_reflectors(problem))
    if not causes:
        errors, own = ordered.errors(result.x), np.isin(ordered.labels, problem.labels)
        likely = own | (errors <= np.nanmax(errors[own]))  # held-out rows that are gross errors were not looked for
        alone, x = ordered.on(ordered.data.take(np.flatnonzero(likely))), result.x
        if result.learned is not None and result.learned.added:  # curves take up ratios and scales of all kinds
            p = problem.parameters
            alone = alone.identifying(p.identified & ~np.isin(p.names, result.learned.added))
            x = settled(alone)
        causes = first(diagnosis.shown_by_residuals(alone, x), diagnosis.scattering_joint(alone, x))
    error = rms(problem.errors(result.x)[kept_rows(result)])
    causes = first(causes, diagnosis.rounded(problem, error))
    if causes or error < LARGEST["length"]:  # which a robot's own effects may be
        return causes
    odd = diagnosis.odd_columns(problem), diagnosis.odd_joint(problem)
    return first(*odd, diagnosis.unrelated_rows(problem, error))


def _in_table_order(result: Outcome, problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem with held-out rows at their places in the table, where labels have numbers."""
    apart = result.record.validation
    if apart is None:
        return problem
    numbers = [re.search(r"\d+$", label) for label in (*problem.data.label, *apart.label)]
    rows = [int(match[0]) for match in numbers if match]
    if len(set(rows)) < len(numbers):  # labels without numbers, or a table of its own
        return problem
    order = np.argsort(rows, kind="stable")
    return problem.on(Dataset.together([problem.data, apart], ["identification", "validation"]).take(order))


def better_fitting(result: Outcome, data: Dataset) -> Better | None:
    """Return the interpretation of new measurements that fits far better; None if they fit, or if there is none.

    Asked where their errors are beyond `HOPELESS` times what the instrument is stated to have.
    """
    problem = result.problem.sample().on(data)
    return better_reading(problem) if noise_ratio(problem, result.errors(data)) > HOPELESS else None


def refuse_misread(result: Outcome, data: Dataset) -> None:
    """Refuse new measurements that `better_fitting` interprets differently."""
    better = better_fitting(result, data)
    if better is not None:
        left = f"errors of {1e3 * better.stated:.3g} mm, but {1e3 * better.left:.3g} mm with {better.what}"
        raise InputError("the new measurements", left, better.remedy)


def misread(result: Outcome, data: Dataset) -> str:
    """Return the result of `better_fitting` as a sentence, empty for None."""
    better = better_fitting(result, data)
    return "" if better is None else f"Likely: {better.sentence}"


def mistakes(causes: Sequence[str]) -> list[str]:
    """Return the input mistakes among `likely_causes`."""
    return [text for text in causes if text != NOTHING and not text.startswith(BAD)]
