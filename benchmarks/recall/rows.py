"""The row of one image: made, searched as a user would, each direction held against the truth."""

import os
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.recall.images import IMAGES, Image, declare
from benchmarks.recall.oracle import Needle, Oracle, Scene
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.context import prepare

DEFAULT_MARGIN_MM = 5.0
"""Of every structure, where the product refuses a case and so states none."""


def measured(name: str, real: Path | None, declared: bool = True) -> dict:
    """The row of one image, with what a person states of it or without."""
    image = next(one for one in IMAGES if one.name == name)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as cache:
        os.environ["PUNCTURE_TWIN_CACHE"] = cache
        row = judged(Path(folder), image, real, declared)
    return {"name": name, "ambiguous": image.ambiguous, **row, "seconds": round(time.perf_counter() - began, 1)}


def judged(folder: Path, image: Image, real: Path | None = None, declared: bool = True) -> dict:
    """Make, search, and hold every direction against the truth."""
    try:
        scene = image.make(folder, real)
        if declared and image.arms is not None:
            declare(folder, image.arms)
    except InputError as error:
        return _refused(str(error))
    try:
        return _searched(folder, scene)
    except InputError as error:
        scene.margins.update(dict.fromkeys(scene.structures, DEFAULT_MARGIN_MM))
        truth = Oracle(scene, _plain_needle())(bed_directions())
        return _refused(str(error), int(truth.free.sum()), int(truth.unseen.sum()))


def _refused(said: str, free: int | None = None, unseen: int | None = None) -> dict:
    return {"free": free, "safe_of_free": 0, "wrong": 0, "unseen": unseen, "recall": 0.0, "refused": said[:300]}


def bed_directions(step_deg: float = 6.0):
    """Over the whole sphere, shape (n, 3), from the target outward; theta from the front, each pole once."""
    theta, beta = np.radians(np.mgrid[0 : 180 + step_deg / 2 : step_deg, 0:360:step_deg].reshape(2, -1))
    u = np.stack([-np.sin(theta) * np.sin(beta), -np.cos(theta), np.sin(theta) * np.cos(beta)], axis=1)
    return u[(beta == 0) | ((theta > 1e-9) & (theta < np.pi - 1e-9))]


def _plain_needle():
    return Needle(200.0, 150.0, 0.6, 15.0, np.radians(60.0), lambda path, angle: path + 20.0)


def _searched(folder: Path, scene: Scene) -> dict:
    context = prepare(folder, arm=False)
    found, case = context.search(), context.case
    stated = {one.name: one.margin_mm for one in context.anatomy.structures if one.demands_margin}
    scene.margins.update({name: stated[name] for name in scene.structures if name in stated})
    one = case.needle
    needle = Needle(
        one.length_mm,
        one.shaft_mm,
        one.radius_mm,
        one.holder_diameter_mm / 2,
        case.search.max_skin_angle,
        partial(standoffs, one),
    )
    pole = np.sin(found.theta) < 1e-9
    rows = np.flatnonzero(~pole | (found.beta < 1e-9))
    truth = Oracle(scene, needle)(found.outward_ct[rows])
    safe = found.safe[rows]
    lost = rows[truth.free & ~safe]
    named = found.verdict.structure
    why = Counter(f"{found.verdict.reason[row]}: {named[row]}".rstrip(": ") for row in lost)
    free, kept, wrong = int(truth.free.sum()), int((truth.free & safe).sum()), np.flatnonzero(truth.wrong & safe)
    worst = [
        {
            "theta_deg": round(float(np.degrees(found.theta[rows[k]])), 1),
            "beta_deg": round(float(np.degrees(found.beta[rows[k]])), 1),
            "near_mm": round(float(truth.near[k]), 1),
            "passes_mm": round(float(truth.passes[k]), 1),
            "unseen": bool(truth.unseen[k]),
        }
        for k in wrong[np.argsort(np.minimum(truth.near, truth.passes)[wrong])][:5]
    ]
    return {
        "free": free,
        "safe_of_free": kept,
        "wrong": len(wrong),
        "unseen": int((truth.unseen & (np.nan_to_num(truth.path, nan=1e9) <= needle.shaft)).sum()),
        "recall": round(kept / free, 3) if free else None,
        "safe": int(safe.sum()),
        "safe_unseen": int((safe & truth.unseen).sum()),
        "directions": len(rows),
        "refused_by": dict(why.most_common()),
        "worst": worst,
        "warnings": list(context.anatomy.warnings),
    }
