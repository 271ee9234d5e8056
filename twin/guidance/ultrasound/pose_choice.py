"""Which of many possible poses to record: those that tell most about the error at the tip.

The bound can count errors of the arms that all poses share, as unknowns with a prior behind the parameters (their
deviations are 1): poses that repeat one of them do not average it out, and poses that show it correct the aim. The
choice does not count them: so chosen, a region from found noise holds the truth less often than it says.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms, arm_errors
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate, active_columns, parameter_units
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, linear_model
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.whitening import whitener

PRIOR_WEIGHT = 1e-6
"""Information that every parameter is taken to have beforehand, as a fraction of a candidate's; for the first picks."""

NO_INFORMATION = 1e-13
"""Least over largest eigenvalue of an information matrix below which nothing but rounding is left."""

N_FREE = len(active_columns(tip=True, scale=False, direction=False))
"""Parameters of the calibration; the arms' errors stand behind them."""

MAX_SWEEPS = 20
"""How often all chosen poses are looked at for a better exchange."""

WORTH = 1e-4
"""An exchange must lower the mean squared error by this share."""


class _Design(NamedTuple):
    """What every candidate tells, and what is to be known."""

    rows: Floats
    """Jacobian of each candidate over its residuals' spread, shape (n, 3, p), p of parameters and arms' errors: its
    information is rows^T rows."""
    wanted: Floats
    """Mean of J^T J over the workspace, shape (p, p): trace(C wanted) is the mean squared error at the tip."""
    base: Floats
    """Information held beforehand, shape (p, p)."""

    def information(self, index: int) -> Floats:
        """Of one candidate, shape (p, p)."""
        return np.asarray(self.rows[index].T @ self.rows[index])


def choose_poses(
    candidates: Recording,
    n: int,
    noise: Noise,
    prior: Calibration | Estimate,
    *,
    recorded: Recording | None = None,
) -> NDArray[np.int_]:
    """Choose poses by Fisher information: greedily, then by exchange until no single exchange helps.

    What is minimised is the mean squared error at the tip over all candidates: A-optimal for that error.

    Args:
        candidates: Poses that could be recorded, with the tip where it would show.
        n: How many to choose.
        noise: Of both arms and the image.
        prior: A rough calibration, such as the drawing's: 10 deg and 20 mm off will do.
        recorded: Poses that are recorded already and count.

    Returns:
        Indices into the candidates, ascending.

    Raises:
        InputError: More poses wanted than there are candidates, or none.
    """
    if not 0 < n <= len(candidates):
        raise InputError(f"{n} poses of {len(candidates)} candidates", where="pose choice", allowed="1 to all of them")
    prior = prior.estimate if isinstance(prior, Calibration) else prior
    design = _design(candidates, _Belief(noise, prior, None), recorded)
    chosen: list[int] = []
    H = design.base
    for _ in range(n):
        chosen.append(_best(design, H, chosen))
        H = H + design.information(chosen[-1])
    return np.sort(_exchanged(design, H, chosen))


class _Belief(NamedTuple):
    """What is believed before anything is recorded."""

    noise: Noise
    prior: Estimate
    arms: DeclaredArms | None


def expected_tre_mm(
    poses: Recording, noise: Noise, prior: Estimate, workspace: Recording, arms: DeclaredArms | None = None
) -> float:
    """Cramer-Rao bound of the rms error at the tip over a workspace, mm, if these poses are recorded.

    Infinite where they leave a combination of the unknowns free. ``arms``: both arms' lasting errors; every
    recording then needs joints. None takes all errors of flanges for noise.
    """
    belief = _Belief(noise, prior, arms)
    rows = _whitened(poses, belief)
    H = np.einsum("nip,niq->pq", rows, rows)
    values = np.linalg.eigvalsh(H[:N_FREE, :N_FREE])
    if values[0] <= NO_INFORMATION * values[-1]:
        return float("inf")
    return float(np.sqrt(np.trace(np.linalg.solve(_with_prior(H), _wanted(workspace, belief)))))


def _with_prior(H: Floats) -> Floats:
    """Information with what is known of the arms' errors beforehand: their deviation is 1."""
    return H + np.diag((np.arange(len(H)) >= N_FREE).astype(float))


def _slopes(recording: Recording, belief: _Belief) -> tuple[Floats, Floats]:
    """Residuals by parameters in their units and by the arms' errors, (n, 3, p), and their own noise, (n, 3, 3)."""
    active = active_columns(tip=True, scale=False, direction=False)
    errors = None if belief.arms is None else arm_errors(belief.arms, recording)
    model = linear_model(Problem(recording, belief.noise, active, arms=errors), belief.prior)
    J = model.jacobian * parameter_units(active, belief.prior.scale)
    return (J if model.shared is None else np.concatenate([J, model.shared], axis=2)), model.sigma


def _whitened(recording: Recording, belief: _Belief) -> Floats:
    slopes, sigma = _slopes(recording, belief)
    return np.asarray(whitener(sigma, np.ones((len(recording), 3))) @ slopes)


def _wanted(workspace: Recording, belief: _Belief) -> Floats:
    J, _ = _slopes(workspace, belief)
    return np.asarray((J.transpose(0, 2, 1) @ J).mean(axis=0))


def _design(candidates: Recording, belief: _Belief, recorded: Recording | None) -> _Design:
    rows = _whitened(candidates, belief)
    base = _with_prior(PRIOR_WEIGHT * np.diag((rows**2).sum(axis=1).mean(axis=0)))
    if recorded is not None:
        known = _whitened(recorded, belief).reshape(-1, rows.shape[2])
        base = base + known.T @ known
    return _Design(rows, _wanted(candidates, belief), base)


def _value(design: _Design, H: Floats) -> float:
    """Mean squared error at the tip, mm^2."""
    return float(np.trace(np.linalg.solve(H, design.wanted)))


def _values_with(design: _Design, H: Floats) -> Floats:
    """The value with each candidate added, shape (n,), by Woodbury's identity: only 3 x 3 systems are solved."""
    C = np.linalg.inv(H)
    GC = design.rows @ C
    S = np.eye(3) + GC @ design.rows.transpose(0, 2, 1)
    gained = np.linalg.solve(S, GC @ design.wanted @ GC.transpose(0, 2, 1))
    return np.asarray(_value(design, H) - np.trace(gained, axis1=1, axis2=2))


def _best(design: _Design, H: Floats, without: list[int]) -> int:
    """The candidate whose addition leaves the least value."""
    values = _values_with(design, H)
    values[without] = np.inf
    return int(np.argmin(values))


def _exchanged(design: _Design, H: Floats, chosen: list[int]) -> NDArray[np.int_]:
    """Give each chosen pose up for the best other one, until none is worth it (Fedorov 1972)."""
    for _ in range(MAX_SWEEPS):
        changed = False
        for place, index in enumerate(list(chosen)):
            without = H - design.information(index)
            best = _best(design, without, chosen[:place] + chosen[place + 1 :])
            after = without + design.information(best)
            if best != index and _value(design, after) < (1 - WORTH) * _value(design, H):
                chosen[place], H, changed = best, after, True
        if not changed:
            break
    return np.array(chosen)
