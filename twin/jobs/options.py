"""The options that several commands share, and how a command takes its choice of a candidate."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from puncture_twin.planning.base.files import check_writable
from puncture_twin.twin.jobs.terminal import default_out
from puncture_twin.twin.report.progress import progress_display

if TYPE_CHECKING:
    from puncture_twin.planning.search.context import CaseContext

CaseArgument = Annotated[Path, Argument(metavar="CASE", help="Case file, or the folder that holds case.toml.")]
SourceArgument = Annotated[Path, Argument(metavar="CASE_OR_PLAN", help="A case, or a plan.json.")]
OutOption = Annotated[Path, Option("--out", help="Output folder.", callback=check_writable)]
OutOfCaseOption = Annotated[Path | None, Option("--out", help="Output folder.", show_default="out/CASE-COMMAND")]
CohortOption = Annotated[Path, Option("--out", metavar="DIR", help="Folder of the cohort.", callback=check_writable)]
JsonOption = Annotated[bool, Option("--json", help="Print one JSON object on stdout and nothing else.")]
JobsOption = Annotated[int, Option("--jobs", min=1, help="Processes, at most one per core; the result is the same.")]
EngineOption = Annotated[str, Option("--engine", help="Clearance engine: fast, or fcl (the reference).")]
PicturesOption = Annotated[bool, Option("--pictures/--no-pictures", help="Draw the map, the scene and the page.")]
ArmOption = Annotated[
    bool | None,
    Option(
        "--arm/--no-arm",
        help="Require that the arm reaches a candidate.",
        show_default="on if the case states its base",
    ),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        sys.stdout.write(f"puncture-twin {version('puncture-twin')}\n")
        raise typer.Exit


VersionOption = Annotated[
    bool, Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
]


def out_folder(named: Path | None, source: Path, command: str) -> Path:
    """The folder of `OutOfCaseOption`, which must be one that can be written to."""
    return check_writable(named or default_out(source, command))


@contextmanager
def prepared(case: Path, *, arm: bool | None = None, engine: str = "fast") -> Iterator[CaseContext]:
    """A case as `prepare` gives it, whose progress is shown while the block runs."""
    from puncture_twin.planning.search.context import prepare

    with progress_display() as progress:
        yield prepare(case, arm=arm, engine=engine, watcher=progress)


CHOICE_OPTIONS = {  # what names a candidate, in the order in which `parse_choice` takes it
    "theta": Annotated[float | None, Option("--theta", min=0, max=180, help="Puncture angle, degrees.")],
    "beta": Annotated[float | None, Option("--beta", min=0, max=360, help="Azimuth, degrees.")],
    "rank": Annotated[int | None, Option("--rank", min=1, help="Rank in the search; 1 is the best candidate.")],
    "window": Annotated[int | None, Option("--window", min=1, help="Best candidate of this window.")],
    "entry": Annotated[
        str | None,
        Option("--entry", metavar="X,Y,Z", help="Entry point on the skin, mm, in the case's space; or a Slicer line."),
    ],
}


def with_choice(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `CHOICE_OPTIONS` where it has a parameter ``choice``.

    typer reads a command's options from its signature and knows no groups of them. What the options say is parsed, and
    refused where it is contradictory, before the command starts.
    """
    signature = inspect.signature(command, eval_str=True, locals={"Choice": object})
    keyword = inspect.Parameter.KEYWORD_ONLY
    named = [inspect.Parameter(name, keyword, default=None, annotation=one) for name, one in CHOICE_OPTIONS.items()]
    parameters: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        parameters += named if parameter.name == "choice" else [parameter.replace(kind=keyword)]

    @functools.wraps(command)
    def chosen(**values: Any) -> None:
        from puncture_twin.planning.search.choice import parse_choice

        choice = parse_choice(*(values.pop(name) for name in CHOICE_OPTIONS))
        command(**values, choice=choice)

    chosen.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    chosen.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # inspect reads it
    return chosen
