"""CVXPY's functions by name: they are CVXPY's own, and what they declare is what CVXPY's canonicalization shows."""

from __future__ import annotations

import pickle

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex import Formulation
from rpim_opt.convex import expressions as atoms
from rpim_opt.convex.expressions import ATOMS, SQUARES, named
from rpim_opt.convex.formulation import FORMULATIONS
from rpim_opt.convex.quadratic import quadratic
from rpim_opt.convex.structure import Expressions, declared

DECLARED = {name: each for name, each in FORMULATIONS.items() if declared(each)}


@pytest.mark.parametrize("atom", ATOMS)
def test_an_atom_is_the_function_of_its_name(atom: atoms.Atom) -> None:
    own = getattr(cp, atom.name)
    v = cp.Variable(3, value=np.array([1.0, -2.0, 3.0]))
    assert named(own) is atom
    assert named(atom) is atom
    assert atom(v).value == own(v).value
    assert repr(atom) == f"cp.{atom.name}"


def test_a_function_of_the_user_stays_the_user_s() -> None:
    mine = lambda v: cp.sum_squares(v)  # noqa: E731
    assert named(mine) is mine
    assert named(None) is None


def test_the_word_for_optimal_is_cvxpy_s() -> None:
    assert atoms.OPTIMAL == cp.OPTIMAL


@pytest.mark.parametrize("stated", FORMULATIONS.values())
def test_a_formulation_in_cvxpy_s_functions_is_the_ready_one(stated: Formulation) -> None:
    def own(function):
        if function in ATOMS:
            return getattr(cp, function.name)
        return function

    again = Formulation(
        stated.name, own(stated.loss), own(stated.penalty), stated.constraints, stated.loss_over, stated.penalty_over
    )
    assert again == stated
    assert pickle.loads(pickle.dumps(again)) == stated


def test_what_is_known_without_asking() -> None:
    assert set(DECLARED) == {"least_squares", "tikhonov", "bounded"}
    assert not declared(Formulation("mine", penalty=lambda z: cp.sum_squares(z)))
    assert not declared(Formulation("norms", loss=SQUARES, loss_over="configuration"))


@pytest.mark.parametrize("stated", DECLARED.values())
def test_what_is_declared_is_what_the_canonicalization_shows(stated: Formulation) -> None:
    problem = ro.load("paper_arm").problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    program = ro.convex.pose(stated, model)
    equations, n = model.A.shape
    asked = Expressions(stated, model.parameters, equations, model.group)
    rng = np.random.default_rng(0)
    r, z = rng.normal(size=equations), rng.normal(size=n)
    loss = quadratic(asked.loss.expression, asked.loss.variable)
    assert loss is not None
    assert program.loss_form is not None
    assert program.structure.loss_of(r) == pytest.approx(loss.value(r), rel=1e-12)
    if stated.penalty is None:
        assert program.penalty_form is None
        return
    penalty = quadratic(asked.penalty.expression, asked.penalty.variable)
    assert penalty is not None
    assert program.penalty_form is not None
    assert program.penalty_form.value(z) == pytest.approx(penalty.value(z), rel=1e-12)
