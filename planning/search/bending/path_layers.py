"""The tissues along one path, from the skin to the target."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.labels.naming import REST
from puncture_twin.planning.needle.deflection import Bending, shortest_bend, stiffest_resolved
from puncture_twin.planning.needle.tissue import Layer
from puncture_twin.planning.search.along_path import inside_at

STEP_MM = 0.5
"""Between two samples of a path."""


def check_tissues(case: Case, anatomy: Anatomy) -> None:
    """Refuse tissues that match no structure, contradict each other, or are too stiff for so thin a needle.

    Raises:
        InputError: One of them.
    """
    if case.bending is None:
        return
    tissues, most = case.bending.tissues, stiffest_resolved(case.bending.shaft)
    tissues.check([one.name for one in anatomy.structures], "tissue", case.path)
    for pattern, tissue in tissues.of_pattern.items():
        if tissue.stiffness_n_mm2 > most:
            bend = shortest_bend(case.bending.shaft)
            what = f"tissue.{pattern}: {tissue.stiffness_n_mm2:g} N/mm2 bends this shaft within {bend:.2g} mm"
            allowed = f"at most {most:.3g} N/mm2 for it: beyond, no bound of its bending is known"
            raise InputError(what, where=case.path, allowed=allowed)


def path_layers(
    bending: Bending, anatomy: Anatomy, target_ct: Floats, outward_ct: Floats, path_length: float
) -> tuple[Layer, ...]:
    """What a needle passes, the skin first. In nested structures the smallest counts, by its box.

    A surface is a capsule where it is entered. That of the rest is the skin: coming out of an organ there is none.

    Args:
        bending: Of the case.
        anatomy: Its structures; only closed ones have an inside.
        target_ct: Shape (3,), mm.
        outward_ct: Shape (3,), unit.
        path_length: Target to skin, mm.
    """
    count = max(1, round(path_length / STEP_MM))
    edges = np.linspace(0.0, path_length, count + 1)
    depths = path_length - 0.5 * (edges[1:] + edges[:-1])
    names = np.full(count, REST, dtype=object)
    for one in sorted((s for s in anatomy.structures if s.mesh.closed), key=_size, reverse=True):
        names[inside_at(one, target_ct, outward_ct, depths)] = one.name
    layers: list[Layer] = []
    for name, group in groupby(range(count), key=lambda at: names[at]):
        rows = list(group)
        tissue = bending.tissues.of(str(name)) or bending.tissues.of_pattern[REST]
        at_skin = not layers
        if not at_skin and tissue == bending.tissues.of_pattern[REST]:
            tissue = replace(tissue, capsule_n=0.0, capsule_mm=0.0)
        layers.append(Layer(float(edges[rows[0]]), float(edges[rows[-1] + 1]), tissue))
    return tuple(layers)


def _size(structure: Structure) -> float:
    """Volume of a structure's bounding box, mm^3."""
    low, high = structure.mesh.bounds
    return float(np.prod(high - low))
