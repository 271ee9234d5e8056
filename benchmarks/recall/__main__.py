"""Wrong beside recall, for every image: what is called safe and is not, and what is free beyond doubt and is refused.

    python -m benchmarks.recall [--real FOLDER] [--only NAME,...] [--fine] [--undeclared] [--json FILE] [--markdown]

FOLDER holds totalseg_abdomen_3mm and slicer_chest_ct4 (default: ../shared/data beside the repository); where it is not
there, their images are left out, and it is said. Two processes; a line an image as it ends. The images are in `images`,
the truth in `oracle`; the search is the product's, without the arm, on a grid of 6 degrees over all directions (a pole
counts once). Of each image the case states what a person sees of arms in it (`[ct] arms`, as `init` proposes); with
--undeclared it states nothing, and all beyond a face that cuts the body is unknown. Each image has a cache of its own.
"""

import argparse
import json
import multiprocessing
import sys
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.recall.images import IMAGES
from benchmarks.recall.rows import measured

REAL = Path(__file__).resolve().parents[3] / "shared" / "data"
"""Real data beside the repository."""


def line(row: dict) -> str:
    """One image for the screen."""
    why = ", ".join(f"{count} {what}" for what, count in list(row.get("refused_by", {}).items())[:3])
    figures = f"{row['safe_of_free']} of {row['free']} free, {row['wrong']} wrong, {row['unseen']} unseen"
    name = row["name"] + (" (ambiguous)" if row["ambiguous"] else "")
    said = row.get("refused") or why or "-"
    return f"{name}: {figures}, recall {row['recall']}; {said} [{row['seconds']} s]"


def markdown(rows: list[dict]) -> str:
    """The table for docs, with the sums below."""
    lines = [
        "| image | ambiguous | free | safe of them | recall | wrong | unseen | what refused most |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        why = "; ".join(f"{what} {count}" for what, count in list(row.get("refused_by", {}).items())[:2])
        what = "the case" if "refused" in row else why
        recall = "-" if row["recall"] is None else f"{row['recall']:.2f}"
        cells = (
            row["name"],
            "yes" if row["ambiguous"] else "",
            row["free"],
            row["safe_of_free"],
            recall,
            row["wrong"],
            row["unseen"],
            what,
        )
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
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.recall", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--real", type=Path, default=REAL)
    parser.add_argument("--only", default="")
    parser.add_argument("--fine", action="store_true")
    parser.add_argument("--undeclared", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args(arguments)
    only = [one for one in options.only.split(",") if one]
    unknown = set(only) - {one.name for one in IMAGES}
    if unknown:
        parser.error(f"no image {', '.join(sorted(unknown))}; there are {', '.join(one.name for one in IMAGES)}")
    chosen = [one for one in IMAGES if one.name in only or (not only and one.fine <= options.fine)]
    if not options.real.is_dir() and any(one.real for one in chosen):
        print(
            f"left out, {options.real} is not there: {', '.join(one.name for one in chosen if one.real)}",
            file=sys.stderr,
        )
        chosen = [one for one in chosen if not one.real]
    found = {}
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=4) as pool:
        measure = partial(measured, real=options.real, declared=not options.undeclared)
        for row in pool.imap_unordered(measure, [one.name for one in chosen]):
            print(line(row), flush=True)
            found[row["name"]] = row
    rows = [found[one.name] for one in chosen]
    if options.json is not None:
        options.json.write_text(json.dumps({"summary": summary(rows), "rows": rows}, indent=1) + "\n", encoding="utf-8")
    print(markdown(rows) if options.markdown else summary(rows))
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
