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
from puncture_twin.planning.uncertainty.lines.line_rules import by_lines, few_lines, many_lines
from puncture_twin.planning.uncertainty.lines.needle_doubt import NeedleDoubt, Problem

MANY_LINES, MOST_LINES = 128, 512
"""Where something else is touched about as soon as what is likeliest, or sizes are uncertain; where these disagree."""

DISAGREE = 0.1
"""Standard deviation of the lines' chances up to which few are trusted with .003: against 4,096 lines they err by that
at most, and by .013 where it is .2 (three anatomies; beside a lung and between ribs)."""


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
    basis = _basis(likeliest, doubt.surface_mm / steep, float(np.linalg.norm(likeliest)) / steep)
    first = -_slack(problem) / max(sigma, 1e-12)
    return _chance(problem, doubt, basis, first, alone)


def _slack(problem: Problem) -> float:
    """Of the nominal needle, mm."""
    triangles, faces, blocks, origin, outward, length, threshold = problem
    tip = (float(origin[0]), float(origin[1]), float(origin[2]))
    along = (float(outward[0]), float(outward[1]), float(outward[2]))
    return min(float(displaced_distance(triangles, faces, blocks, tip, along, length, -1.0, 0)[0]), 1e9) - threshold


def _chance(problem: Problem, doubt: NeedleDoubt, basis: Floats, first: float, alone: bool) -> float:
    """By the small rule; by many lines where its lines disagree, or several things are touched, or by most lines.

    Where the errors' size is uncertain every line has its own, and the lines say by how much first order, of quantile
    ``first``, errs.
    """
    surface = doubt.surface_mm > 0.0
    rules = [many_lines(surface, count, doubt.freedom) for count in (MANY_LINES, MOST_LINES)]
    if alone and doubt.freedom is None:
        rules.insert(0, few_lines(surface))
    for lines in rules:
        mean, spread = by_lines(problem, doubt, basis, lines, first)
        if spread <= DISAGREE:
            break
    return min(max(mean, 0.0), 1.0)


def _basis(slope: Floats, by_surface: float, by_pose: float) -> Floats:
    """Orthonormal rows (6, 6) of six normals (five of the pose, the surface's): a, four across, the mixed one."""
    size = float(np.linalg.norm(slope))
    down = -slope / size if size > 0.0 else np.eye(5)[0]
    frame = np.linalg.qr(np.column_stack([down, np.eye(5)]))[0]
    basis = np.zeros((6, 6))
    basis[0, :5], basis[0, 5] = by_pose * down, -by_surface
    basis[1:5, :5] = frame[:, 1:5].T
    basis[5, :5], basis[5, 5] = by_surface * down, by_pose
    return basis
