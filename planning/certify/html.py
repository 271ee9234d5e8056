"""How a certificate shows itself in a notebook."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.planning.base.html import Facts, card, never_raises
from puncture_twin.planning.base.polar_map import Entry, Sectors, polar_map
from puncture_twin.planning.base.reasons import REASON_COLOURS, REASON_TEXT, SAFE, Rgb

UNDECIDED: Rgb = (255, 255, 255)
"""Of cells that are too small to say: neither a safe colour nor a reason's."""


@never_raises
def certificate_html(certificate: Any) -> str:
    """A table of facts, and the map of the cells: proven safe for the organs, rejected, undecided."""
    title = f"Certificate of {certificate.question.case_name}"
    return card(title, _facts(certificate), _map(certificate))


def _facts(certificate: Any) -> Facts:
    summary = certificate.summary()
    for word in ("safe", "rejected", "undecided"):
        text = "proven safe for the organs" if word == "safe" else word
        yield text, f"{summary[f'{word}_square_deg']:.2f} deg², {summary[f'{word}_cells']:,} cells"
    yield "cells are halved down to", f"{summary['size_deg']:g}°"
    yield "holds all over a safe cell", "; ".join(summary["certified"])
    yield "says nothing about", "; ".join(summary["not_certified"])


def _map(certificate: Any) -> str:
    reasons = list(REASON_COLOURS)
    legend = [
        Entry("proven safe for the organs", SAFE),
        *(Entry(REASON_TEXT[reason], REASON_COLOURS[reason]) for reason in reasons),
        Entry("undecided", UNDECIDED),
    ]
    number = {reason.value: row for row, reason in enumerate(reasons, start=1)}
    letters = zip(certificate.verdict, certificate.reason, strict=True)
    code = np.array([{"S": 0, "U": len(legend) - 1}.get(letter, number.get(str(why), 1)) for letter, why in letters])
    beta = certificate.leaves.beta
    shifted = beta - 2 * np.pi * np.floor(beta[:, :1] / (2 * np.pi))
    return polar_map(Sectors(certificate.leaves.theta, shifted, code), legend)
