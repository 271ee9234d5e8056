"""What `register` prints of one insertion, held against registrations of markers that are drawn anew.

    python -m benchmarks.one_insertion [DRAWS]

3 to 8 markers about a target, read with normal noise in both lists, fitted rigidly; the target is read as a marker is.
The limit is printed from the noise that is stated, or from that which each registration's residuals show. The last
columns are what the rms without the target's reading would hold, and the upper end of its 95 % interval.
"""

import sys
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register
from puncture_twin.twin.jobs.patient.answers import noise_of_lists, one_insertion

FLE_MM = 1.2
TARGET = np.array([10.0, -20.0, 70.0])
T = np.array([[0.36, -0.48, 0.8, 300.0], [0.8, 0.6, 0.0, -50.0], [-0.48, 0.64, 0.6, 120.0], [0.0, 0.0, 0.0, 1.0]])


class Held(NamedTuple):
    """Fractions of targets within what is printed."""

    stated: float
    found: float
    rms: float
    interval: float


def markers_of(count: int) -> np.ndarray:
    """So many on a dome of 100 mm, shape (count, 3)."""
    angles = 2.4 * np.arange(count)
    rise = np.linspace(0.95, 0.3, count)
    return 100.0 * np.column_stack([np.cos(angles) * np.sqrt(1 - rise**2), np.sin(angles) * np.sqrt(1 - rise**2), rise])


def held(count: int, draws: int, rng: np.random.Generator) -> Held:
    """Registrations of so many markers; every limit follows from the one of residuals of size 1."""
    points, sd = markers_of(count), FLE_MM / np.sqrt(6.0)
    all_ct = np.vstack([points, TARGET])
    ct = all_ct + sd * rng.normal(size=(draws, count + 1, 3))
    base = apply(T, all_ct) + sd * rng.normal(size=(draws, count + 1, 3))
    fitted = fit_rigid(ct[:, :-1], base[:, :-1])
    there = np.einsum("nab,nkb->nka", fitted[:, :3, :3], ct) + fitted[:, None, :3, 3]
    squares = np.sum((there - base) ** 2, axis=2)
    error, fre = np.sqrt(squares[:, -1]), np.sqrt(squares[:, :-1].mean(axis=1))
    size = fre * np.sqrt(count / (count - 2)) / FLE_MM  # Fitzpatrick 1998
    stated, found, rms, upper = printed(count, rng)
    shares = (error <= stated, error <= size * found, error <= size * rms, error <= size * upper)
    return Held(*(float(np.mean(share)) for share in shares))


def printed(count: int, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Of `FLE_MM` as stated and as found: both limits, and of found noise the expected TRE and its interval's end."""
    points = markers_of(count)
    pairs = MarkerPairs(tuple("ABCDEFGH"[:count]), points, apply(T, points) + 0.4 * rng.normal(size=points.shape))
    stated = register(pairs, method="rigid", target_ct=TARGET, noise=noise_of_lists(pairs, 10.0))
    found = register(pairs, method="rigid", target_ct=TARGET, noise=noise_of_lists(pairs, None), noise_found=True)
    limit, size = one_insertion(stated, TARGET, None)["one_insertion_95_mm"], FLE_MM / found.fle_mm
    rms, upper = found.expected_tre_mm(TARGET[None])[0], found.expected_tre_interval_mm(TARGET).high
    return (
        limit * FLE_MM / 10.0,
        size * one_insertion(found, TARGET, None)["one_insertion_95_mm"],
        size * rms,
        size * upper,
    )


def main() -> None:
    """Print the table."""
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    print("| markers | limit, noise stated | limit, noise of the residuals | rms | its 95 % |\n|---|---|---|---|---|")
    for count in range(3, 9):
        print(
            f"| {count} | "
            + " | ".join(f".{1000 * share:03.0f}" for share in held(count, draws, np.random.default_rng(count)))
            + " |"
        )


if __name__ == "__main__":
    main()
