"""The chance to touch, beyond first order: the needle is moved along lines, and where it touches is found.

With Sigma5 the covariance of the tip's shift and of the lean across the needle (turning about its own axis moves it
nowhere), xi = B z, B B' = Sigma5, and z standard normal, every line is

    z = y + beta a,   a = -B'g / sigma,   y across a,      P = E_y[sum Phi(beta_out) - Phi(beta_in)]

over the stretches of the line on which the needle is nearer than the threshold (line sampling: Koutsourelakis,
Pradlwarter, Schueller, Prob. Eng. Mech. 19, 2004). The mean over y is a rule of 25 lines, exact to the fifth degree
(Stroud, Approximate Calculation of Multiple Integrals, 1971, E_n^r2 5-2 with n = 4). Where its lines disagree, or
several things are about as likely, 128 lines spread by Sobol; where these disagree, 512. Where another direction
touches sooner than first order's, which 51 rays tell, a is that one. A line is walked in steps that no approach can
outrun, so that entry *and* exit of every stretch are found. A surface that may lie off as a whole is one more normal;
errors whose size is uncertain give every line a size of its own.
"""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.kernels.displaced_axis import displaced_distance
from puncture_twin.planning.clearance.near_faces import NearFaces
from puncture_twin.planning.uncertainty.lines.likeliest import likeliest_slope
from puncture_twin.planning.uncertainty.lines.line_rules import (
    chance_by_rules,
    line_basis,
)
from puncture_twin.planning.uncertainty.lines.needle_doubt import NeedleDoubt, Problem


def line_chance(near: NearFaces, doubt: NeedleDoubt, length: float, threshold: float, gradient: Floats) -> float:
    """P that the needle comes nearer to a structure than a threshold; NaN where nothing displaces it.

    Args:
        near: The structure's faces within `NeedleDoubt.reach` of the axis.
        doubt: The needle and its doubt.
        length: Of the axis, mm.
        threshold: Needle radius, or that and a margin, mm.
        gradient: Shape (6,), g: what shift and rotation do to the distance, to first order.
    """
    problem = (near.triangles, near.faces, near.blocks, doubt.origin, doubt.outward, float(length), float(threshold))
    slope = doubt.root.T @ gradient
    sigma = math.hypot(float(np.linalg.norm(slope)), doubt.surface_mm)
    likeliest, alone = likeliest_slope(problem, doubt, slope, _slack(problem))
    steep = math.hypot(float(np.linalg.norm(likeliest)), doubt.surface_mm)
    if not steep > 0.0:
        return math.nan
    basis = line_basis(likeliest, doubt.surface_mm / steep, float(np.linalg.norm(likeliest)) / steep)
    first = -_slack(problem) / max(sigma, 1e-12)
    return chance_by_rules(problem, doubt, basis, first, alone)


def _slack(problem: Problem) -> float:
    """Of the nominal needle, mm."""
    triangles, faces, blocks, origin, outward, length, threshold = problem
    tip = (float(origin[0]), float(origin[1]), float(origin[2]))
    along = (float(outward[0]), float(outward[1]), float(outward[2]))
    return min(float(displaced_distance(triangles, faces, blocks, tip, along, length, -1.0, 0)[0]), 1e9) - threshold
