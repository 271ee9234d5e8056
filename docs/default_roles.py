"""Write docs/reference/default-roles.md from the table that ``init`` uses: ``python docs/default_roles.py``."""

from pathlib import Path

from puncture_twin.planning.anatomy.default_roles import BY_REGION, GENERAL, UNKNOWN_NAME

HEAD = """# Default roles and margins

What `init` writes for a structure, by its name. Capitals, spaces and signs do not count: "Left Lung" is `left_lung`.
Of several lines that match, the one with the longest pattern holds; a lesion is a lesion whatever organ it is of, and a
line that avoids holds before one that traverses: `thigh_artery` is no muscle, `intracranial_vessels` are no skull. The
structure that holds the target gets the role `target`. Margins, in mm, are a start
that a physician looks at for each patient, not a rule of any society; they are those of the cases in this repository.

**A name like `External` or `patient` is left out (`ignore`) only if it is the outline of the body**: it covers 70 % of
the skin, or a quarter of it, is bounded by it but for its cuts, and holds the target. Anything else of such a name is a
structure that nobody knows: avoided, or `unknown` about the target. Of meshes without a CT the largest of such a name
is the skin, if it holds the others.

**What is crossed is told by every word of its name.** `traverse` becomes a structure that holds the target beside a
lesion, or a muscle or fat, only if each word of its name is known as that of an organ of solid tissue, a bone, a soft
tissue, a lesion, a side or a part (`planning/anatomy/default_roles.py`): `lung_upper_lobe_left`, "liver tumour 2".
An adjective may stand for a vessel or a nerve ("superior thyroid"): beside an organ a position needs a part
(`superior thyroid lobe`), and a `rectus`, `oblique` or `levator` what it belongs to, since some move the eye.
Vessels, nerves, spinal cord, brainstem and heart that hold the target too stay avoided, and `init` refuses. Whatever
else holds it (`AAA`, `Rückenmark`, "liver veins", a bowel) becomes `unknown`: paths through it are `unknown_region`
until the case, which says so beside the name, states `traverse`. The name of a muscle or fat with another word in it
(`V. pectoralis`) is avoided as an unknown name is.

*Written by `python docs/default_roles.py`.*
"""
TABLE = ["| structures | names | role | margin | reason |", "|---|---|---|---|---|"]


def row(line):
    """A row of the table."""
    names = " ".join(f"`{pattern}`" for pattern in line.patterns) or "any other"
    margin = f"{line.margin_mm:g}" if line.margin_mm else ""
    return f"| {line.group} | {names} | {line.kind} | {margin} | {line.reason} |"


def main() -> None:
    """Write the page."""
    lines = [HEAD, "## Every region", *TABLE, *map(row, GENERAL), row(UNKNOWN_NAME)]
    for region, own in BY_REGION.items():
        lines += ["", f'## `region = "{region}"`, before the others', *TABLE, *map(row, own)]
    path = Path(__file__).parent / "reference" / "default-roles.md"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
