"""How many verdicts differ between two label maps of one patient.

    python benchmarks/label_maps.py FOLDER_WITH_THE_CT [--step 2]

The folder holds ct.nii.gz, labels_v1_normal.nii.gz and labels_v2_fast.nii.gz (TotalSegmentator's example).
"""

import argparse
import shutil
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from puncture_twin.planning.search.context import prepare

CASES = Path(__file__).parents[1] / "tests" / "real"


def main() -> None:
    """Search both cases with the organs alone and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--step", type=float, default=2.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        for file in (*CASES.iterdir(), *arguments.data.glob("*.nii.gz")):
            shutil.copy(file, here)
        found = {}
        for version in ("v1", "v2"):
            path = here / f"case_{version}.toml"
            path.write_text(path.read_text().replace("step_deg = 2.0", f"step_deg = {arguments.step}"))
            found[version] = prepare(path, arm=False).search()
    one, two = found["v1"], found["v2"]
    differ = one.safe != two.safe
    print(f"directions {len(one)}, safe by v1 {one.safe.sum()}, by v2 {two.safe.sum()}")
    print(f"verdicts that differ: {differ.sum()}")
    print("rejected by v2 alone, by structure:", dict(Counter(map(str, two.verdict.structure[one.safe & ~two.safe]))))
    print("rejected by v1 alone, by structure:", dict(Counter(map(str, one.verdict.structure[~one.safe & two.safe]))))
    both = one.safe & two.safe
    shared = [name for name in one.clearance.structures if name in two.clearance.structures]
    columns = [
        np.abs(
            one.clearance.distance[both, one.clearance.structures.index(n)]
            - two.clearance.distance[both, two.clearance.structures.index(n)]
        )
        for n in shared
    ]
    print(f"clearances of {len(shared)} shared structures differ by {np.median(columns):.2f} mm in the median")


if __name__ == "__main__":
    main()
