"""Do two checkouts give the same answers, to the last byte?

    python benchmarks/same_answers.py BEFORE AFTER [--data FOLDER_WITH_THE_CT] [--out DIR] [--quick]

BEFORE and AFTER are checkouts of this project. Both run the same commands on the same copies of the embedded cases
and, with --data (TotalSegmentator's example: ct.nii.gz and both label maps), of the real CT: search with a certificate,
plan, export, rehearse, register, place, servo, self-calibration, and the experiment (scan, touch, pivot, sweep). Every
file that is written and all that is printed must be equal, pictures and films included; only wall times may differ.
Each side keeps a cache of its own.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

TIMES = ("timings.json",)
"""Files that hold wall times."""
REFUSED = (b"exit code 2", b"exit code 3")
"""A command that neither side carries out compares nothing."""
EMBEDDED = ("abdomen", "carton", "head", "selfcal")
REAL = Path(__file__).parents[1] / "tests" / "real"


@dataclass(frozen=True)
class Command:
    """One command line: its name, its words after ``run_twin.py``, and whether --quick leaves it out."""

    name: str
    words: tuple[str, ...]
    slow: bool = False


def commands(cases: Path) -> Iterator[Command]:
    """What both checkouts run, in the folder where the outputs of each one lie."""
    for case, file in (("abdomen", "abdomen/case.toml"), ("carton", "carton/case_m.toml")):
        path = str(cases / file)
        yield Command(f"{case}-search", ("search", path, "--out", f"{case}-search", "--certify"))
        yield Command(f"{case}-no-arm", ("search", path, "--no-arm", "--out", f"{case}-no-arm"))
        yield Command(f"{case}-register", ("register", path, "--json"))
        yield Command(f"{case}-plan", ("plan", path, "--out", f"{case}-plan"))
        for form in ("urscript", "ros2", "csv"):
            words = ("export", f"{case}-plan/plan.json", "--format", form, "--case", path)
            yield Command(f"{case}-{form}", (*words, "--out", f"{case}-{form}"))
        yield Command(f"{case}-rehearse", ("rehearse", path, "--out", f"{case}-rehearse"), slow=True)
    carton, angles = str(cases / "carton" / "case_m.toml"), ("--theta", "18", "--beta", "232")
    yield Command("carton-scan", ("scan", carton, "--spacing", "5", "--pixel", "2", "--out", "carton-scan"))
    yield Command("carton-touch", ("touch", carton, *angles, "--out", "carton-touch"), slow=True)
    yield Command("carton-pivot", ("pivot", carton, "--poses", "4", "--out", "carton-pivot"), slow=True)
    yield Command("carton-markers", ("markers", carton, "--propose", "4", "--out", "carton-markers"))
    sweep = ("rehearse", carton, *angles, "--sweep", "--to", "24,226", "--out", "carton-sweep")
    yield Command("carton-sweep", sweep, slow=True)
    check = ("check", str(cases / "abdomen"), "--theta", "30", "--beta", "100", "--json")
    yield Command("abdomen-check", check)
    yield Command("place", ("place", str(cases / "abdomen"), "--out", "place", "--full"), slow=True)
    yield Command("servo", ("servo", str(cases / "head"), "--out", "servo"), slow=True)
    yield Command("selfcal", ("selfcal", str(cases / "selfcal"), "--seeds", "1", "--out", "selfcal"), slow=True)
    yield Command("chen2019", ("reproduce", "chen2019", "--json"))
    for case in sorted((cases / "real").glob("*.toml")):
        yield Command(f"{case.stem}", ("search", str(case), "--out", case.stem, "--certify"))


def main() -> int:
    """Run, compare, print what differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--out", type=Path, help="Where both sides' outputs stay; a temporary folder if left out.")
    parser.add_argument("--quick", action="store_true", help="Without those that take long.")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        out = (arguments.out or Path(name)).resolve()
        copy_cases(arguments.before.resolve(), arguments.data, out / "cases")
        todo = [one for one in commands(out / "cases") if not (arguments.quick and one.slow)]
        for command in todo:
            for side, checkout in (("before", arguments.before), ("after", arguments.after)):
                run(command, checkout.resolve(), out / side)
            print(command.name, *differences(out, command.name) or ["equal"], sep="\n    ", flush=True)
        different = [line for command in todo for line in differences(out, command.name)]
    print(f"{len(todo)} commands, {len(different)} files differ")
    return 1 if different else 0


def copy_cases(checkout: Path, data: Path | None, cases: Path) -> None:
    """The cases of one checkout, once for both sides: the paths in the results are the same then."""
    for name in EMBEDDED:
        shutil.copytree(checkout / "meshes" / name, cases / name, dirs_exist_ok=True)
    if data is not None:
        shutil.copytree(REAL, cases / "real", dirs_exist_ok=True)
        for file in data.resolve().glob("*.nii.gz"):
            shutil.copy(file, cases / "real")


def run(command: Command, checkout: Path, folder: Path) -> None:
    """One command of one checkout; what it prints becomes a file beside what it writes."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PUNCTURE_TWIN_CACHE": str(folder / ".cache")}
    environment.pop("PYTHONPATH", None)
    done = subprocess.run(
        [sys.executable, str(checkout / "run_twin.py"), *command.words],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    (folder / f"{command.name}.stdout").write_text(f"exit code {done.returncode}\n{done.stdout}")
    (folder / f"{command.name}.stderr").write_text(done.stderr)


def differences(out: Path, name: str) -> list[str]:
    """The files of one command that differ, or that one side lacks."""
    before, after = (written(out / side, name) for side in ("before", "after"))
    refused = [f"{name}.stdout: refused or failed" for file in before.values() if file.startswith(REFUSED)]
    lacking = refused + [f"{file}: on one side only" for file in sorted(set(before) ^ set(after))]
    return lacking + [f"{file}: differs" for file in sorted(set(before) & set(after)) if before[file] != after[file]]


def written(side: Path, name: str) -> dict[str, bytes]:
    """What a command printed and wrote, by name; without what holds wall times."""
    files = [side / f"{name}.stdout", *sorted((side / name).rglob("*"))]
    kept = [file for file in files if file.is_file() and file.name not in TIMES]
    return {str(file.relative_to(side)): without_times(file) for file in kept}


def without_times(file: Path) -> bytes:
    """A file's bytes; of what was printed, without the line of wall times."""
    lines = file.read_bytes().splitlines(keepends=True)
    return b"".join(line for line in lines if file.suffix != ".stdout" or not line.startswith(b"seconds: "))


if __name__ == "__main__":
    sys.exit(main())
