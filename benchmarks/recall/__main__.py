"""Wrong beside recall, for every image: what is called safe and is not, and what is free beyond doubt and is refused.

    python -m benchmarks.recall [--real FOLDER] [--only NAME,...] [--fine] [--json FILE] [--markdown]

FOLDER holds totalseg_abdomen_3mm and slicer_chest_ct4; without it their images are left out, and said so. Two
processes; a line an image as it ends. The images are in `images`, the truth in `oracle`; the search is the product's,
without the arm, on a grid of 6 degrees over all directions (a pole counts once). Nothing is read from the user's cache.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

COLUMNS = ("name", "ambiguous", "free", "safe_of_free", "wrong", "unseen", "recall")
DEFAULT_MARGIN_MM = 5.0
"""Of every structure, where the product refuses a case and so states none."""


def measured(name: str, real: Path | None) -> dict:
    """The row of one image."""
    os.environ["PUNCTURE_TWIN_CACHE"] = ""
    from benchmarks.recall.images import IMAGES

    image = next(one for one in IMAGES if one.name == name)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        row = judged(Path(folder), image, real)
    return {"name": name, "ambiguous": image.ambiguous, **row, "seconds": round(time.perf_counter() - began, 1)}


def judged(folder: Path, image, real: Path | None = None) -> dict:
    """Make, search, and hold every direction against the truth."""
    from puncture_twin.planning.base.errors import InputError

    try:
        scene = image.make(folder, real)
    except InputError as error:
        return _refused(str(error))
    try:
        return _searched(folder, scene)
    except InputError as error:
        from benchmarks.recall.oracle import Oracle

        scene.margins.update({one: DEFAULT_MARGIN_MM for one in scene.structures})
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
    from benchmarks.recall.oracle import Needle

    return Needle(200.0, 150.0, 0.6, 15.0, np.radians(60.0), lambda path, angle: path + 20.0)


def _searched(folder: Path, scene) -> dict:
    from benchmarks.recall.oracle import Needle, Oracle
    from puncture_twin.planning.reach.standoff import standoffs
    from puncture_twin.planning.search.context import prepare

    context = prepare(folder, arm=False)
    found, case = context.search(), context.case
    stated = {one.name: one.margin_mm for one in context.anatomy.structures if one.demands_margin}
    scene.margins.update({name: stated[name] for name in scene.structures if name in stated})
    one = case.needle
    needle = Needle(
        one.length_mm, one.shaft_mm, one.radius_mm, one.holder_diameter_mm / 2, case.search.max_skin_angle, partial(standoffs, one)
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


def line(row: dict) -> str:
    """One image for the screen."""
    why = ", ".join(f"{count} {what}" for what, count in list(row.get("refused_by", {}).items())[:3])
    figures = f"{row['safe_of_free']} of {row['free']} free, {row['wrong']} wrong, {row['unseen']} unseen, recall {row['recall']}"
    return f"{row['name']}{' (ambiguous)' if row['ambiguous'] else ''}: {figures}; {row.get('refused') or why or '-'} [{row['seconds']} s]"


def markdown(rows: list[dict]) -> str:
    """The table for docs, with the sums below."""
    lines = ["| image | ambiguous | free | safe of them | recall | wrong | unseen | what refused most |", "|---|---|---|---|---|---|---|---|"]
    for row in rows:
        why = "; ".join(f"{what} {count}" for what, count in list(row.get("refused_by", {}).items())[:2])
        what = "the case" if "refused" in row else why
        recall = "-" if row["recall"] is None else f"{row['recall']:.2f}"
        cells = (row["name"], "yes" if row["ambiguous"] else "", row["free"], row["safe_of_free"], recall, row["wrong"], row["unseen"], what)
        lines.append("| " + " | ".join("" if one is None else str(one) for one in cells) + " |")
    return "\n".join([*lines, "", summary(rows)])


def summary(rows: list[dict]) -> str:
    """Sums: wrong in all; least and mean recall, where nothing is ambiguous and everywhere."""
    said = [f"{len(rows)} images, {sum(row['wrong'] for row in rows)} wrong"]
    for what, some in (("not ambiguous", [row for row in rows if not row["ambiguous"]]), ("all", rows)):
        known = [row["recall"] for row in some if row["recall"] is not None]
        if known:
            said.append(f"recall of {what}: least {min(known):.2f}, mean {np.mean(known):.2f}")
    return "; ".join(said)


def main(arguments: list[str] | None = None) -> int:
    """Exit code 1 where a direction is wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recall", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--real", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--fine", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args(arguments)
    from benchmarks.recall.images import IMAGES

    only = [one for one in options.only.split(",") if one]
    unknown = set(only) - {one.name for one in IMAGES}
    if unknown:
        parser.error(f"no image {', '.join(sorted(unknown))}; there are {', '.join(one.name for one in IMAGES)}")
    chosen = [one for one in IMAGES if one.name in only or (not only and one.fine <= options.fine)]
    if options.real is None and any(one.real for one in chosen):
        print(f"left out without --real: {', '.join(one.name for one in chosen if one.real)}", file=sys.stderr)
        chosen = [one for one in chosen if not one.real]
    found = {}
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=4) as pool:
        for row in pool.imap_unordered(partial(measured, real=options.real), [one.name for one in chosen]):
            print(line(row), flush=True)
            found[row["name"]] = row
    rows = [found[one.name] for one in chosen]
    if options.json is not None:
        options.json.write_text(json.dumps({"summary": summary(rows), "rows": rows}, indent=1) + "\n", encoding="utf-8")
    print(markdown(rows) if options.markdown else summary(rows))
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
