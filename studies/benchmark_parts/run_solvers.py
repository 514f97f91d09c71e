"""Run where skglm and scikit-learn are: lasso, group lasso and Huber paths on exported A and b, as a line of JSON."""

import json
import sys
import time

import numpy as np
from skglm.datafits import Huber, Quadratic, QuadraticGroup
from skglm.penalties import L1, L1_plus_L2, WeightedGroupL2
from skglm.solvers import AndersonCD, GroupBCD
from skglm.utils.jit_compilation import compiled_clone
from sklearn.linear_model import lasso_path

TOLERANCE = 1e-10
"""Of every solver; what it leaves is seen in the objectives."""
RUNS, ENOUGH = 50, 0.5
"""Runs of a path at most, and seconds after which there are no more; two there are always."""
HOW = {"tol": TOLERANCE, "max_iter": 20, "max_epochs": 500, "fit_intercept": False, "warm_start": True}


def main():
    """Print seconds and solutions of paths over weights, (K,) and (K, n), by problem and tool."""
    given = np.load(sys.argv[1])
    A, b = np.asfortranarray(given["A"]), given["b"]
    found = {}
    for name, tool in TOOLS.items():
        weights = given[f"{name.partition(', ')[0]} weights"]
        tool(A, b, weights[:2], given)  # compiles
        seconds = []
        while len(seconds) < 2 or (len(seconds) < RUNS and sum(seconds) < ENOUGH):
            start = time.perf_counter()
            Z = tool(A, b, weights, given)
            seconds.append(time.perf_counter() - start)
        found[name] = {"seconds": min(seconds), "z": np.asarray(Z).tolist()}
    print(json.dumps(found))


def by_sklearn(A, b, weights, given):
    """Return a lasso's path by scikit-learn, with the Gram matrix."""
    alphas = weights / (2 * len(b))
    return lasso_path(A, b, alphas=alphas, tol=TOLERANCE, max_iter=20_000, precompute=True)[1].T


def lasso(A, b, weights, given):
    """Return a lasso's path by skglm."""
    return _path(AndersonCD(**HOW), Quadratic(), lambda w: L1(w / (2 * len(b))), A, b, weights)


def group_lasso(A, b, weights, given):
    """Return a group lasso's path by skglm; the groups are columns side by side."""
    ptr = np.concatenate([[0], given["ends"]]).astype(np.int32)
    indices = np.arange(A.shape[1], dtype=np.int32)
    ones = np.ones(len(ptr) - 1)

    def penalty(w):
        return WeightedGroupL2(w / (2 * len(b)), ones, ptr, indices)

    return _path(GroupBCD(**HOW), QuadraticGroup(ptr, indices), penalty, A, b, weights)


def huber(A, b, weights, given):
    """Return the path of Huber's loss and a squared penalty by skglm."""
    threshold = float(given["threshold"])
    return _path(AndersonCD(**HOW), Huber(threshold), lambda w: L1_plus_L2(w / len(b), 0.0), A, b, weights)


def _path(solver, datafit, penalty, A, b, weights):
    datafit = compiled_clone(datafit)
    datafit.initialize(A, b)
    z = np.zeros(A.shape[1])
    found = []
    for weight in weights:
        z = solver.solve(A, b, datafit, compiled_clone(penalty(weight)), z.copy(), A @ z)[0]
        found.append(z.copy())
    return found


TOOLS = {
    "lasso, scikit-learn": by_sklearn,
    "lasso, skglm": lasso,
    "group lasso, skglm": group_lasso,
    "Huber, skglm": huber,
}
main()
