"""The confidence region of the unknowns where parts of the noise were found from few residuals.

Kenward and Roger, "Small sample inference for fixed effects from restricted maximum likelihood", Biometrics 53(3),
1997: an F whose freedom comes from the doubt of v, Var(v)^-1 = tr(P D_k P D_l) / 2, and a covariance with that doubt
in it. The letters are those of `likelihood`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import f

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import RobustFit, weighed
from puncture_twin.twin.guidance.ultrasound.axp_ybq.noise.parts import structures
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem


class SmallSample(NamedTuple):
    """The confidence region of all p parameters where parts of the noise were found."""

    covariance: Floats
    """Shape (p, p), with the doubt of the noise in it."""
    freedom: float
    """Of Fisher's F's denominator."""
    factor: float
    """What e^T C^-1 e / p is multiplied by to follow that F."""

    def limit(self, level: float) -> float:
        """Largest e^T C^-1 e inside the region."""
        p = len(self.covariance)
        return float(p * f.ppf(level, p, self.freedom) / self.factor)


def small_sample(problem: Problem, fit: RobustFit) -> SmallSample | None:
    """Kenward's and Roger's region at a fit; None where no part of the noise was found."""
    D = structures(problem, fit)
    if not D:
        return None
    at_fit = weighed(problem, fit)
    p = len(problem.active)
    own = _block_diagonal(at_fit.whitener.transpose(0, 2, 1) @ at_fit.whitener)
    slopes = at_fit.jacobian.reshape(len(own), -1)
    J, N = slopes[:, :p], slopes[:, p:]
    inner = np.linalg.inv(np.eye(N.shape[1]) + N.T @ own @ N)
    V = own - own @ N @ inner @ N.T @ own
    return _kenward_roger(V, J, at_fit.covariance[:p, :p], [_block_diagonal(part) for part in D.values()])


def _block_diagonal(blocks: Floats) -> Floats:
    n, k, _ = blocks.shape
    full = np.zeros((n, k, n, k))
    full[np.arange(n), :, np.arange(n)] = blocks
    return full.reshape(n * k, n * k)


def _kenward_roger(V: Floats, J: Floats, C: Floats, parts: list[Floats]) -> SmallSample:
    """The paper's section 3, in its letters: V = Sigma^-1, C = Phi, D_i = dSigma / dv_i."""
    VJ = V @ J
    P = V - VJ @ C @ VJ.T
    PD, VD = [P @ D for D in parts], [V @ D for D in parts]
    W = np.linalg.inv(0.5 * np.array([[np.sum(a * b.T) for b in PD] for a in PD]))
    Pi = [-VJ.T @ D @ VJ for D in parts]
    pairs = [(i, j) for i in range(len(parts)) for j in range(len(parts))]
    CP = [C @ one for one in Pi]
    A1 = sum(W[i, j] * np.trace(CP[i]) * np.trace(CP[j]) for i, j in pairs)
    A2 = sum(W[i, j] * np.sum(CP[i] * CP[j].T) for i, j in pairs)
    doubt = sum(W[i, j] * (VJ.T @ parts[i] @ VD[j] @ VJ - Pi[i] @ C @ Pi[j]) for i, j in pairs)
    size = len(C)
    B = (A1 + 6 * A2) / (2 * size)
    g = ((size + 1) * A1 - (size + 4) * A2) / ((size + 2) * A2)
    below = 3 * size + 2 * (1 - g)
    c1, c2, c3 = g / below, (size - g) / below, (size + 2 - g) / below
    mean = 1.0 / (1.0 - A2 / size)
    variance = 2.0 / size * (1 + c1 * B) / ((1 - c2 * B) ** 2 * (1 - c3 * B))
    freedom = 4 + (size + 2) / (size * variance / (2 * mean**2) - 1)
    adjusted = C + C @ (doubt + doubt.T) @ C
    return SmallSample(0.5 * (adjusted + adjusted.T), float(freedom), float(freedom / (mean * (freedom - 2))))
