"""The commands below ``batch``: they parse, call and print, and load what they need themselves."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from puncture_twin.twin.jobs.exit_codes import finish
from puncture_twin.twin.jobs.options import CohortOption, JobsOption, JsonOption
from puncture_twin.twin.report.progress import progress_display

batch_app = typer.Typer(
    add_completion=False, no_args_is_help=False, pretty_exceptions_enable=False, rich_markup_mode=None
)


@batch_app.command("plan")
def _plan(
    cohort: Annotated[Path, Argument(metavar="COHORT", help="Folder, CSV with column case, or cohort.toml.")],
    out_dir: CohortOption,
    no_arm: Annotated[bool, Option("--no-arm", help="Do not check the arm in any case.")] = False,
    dry_run: Annotated[bool, Option("--dry-run", help="Estimate time, memory and disk; write nothing.")] = False,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """List every case of a cohort. Stores the hash of its inputs, options and version."""
    from puncture_twin.twin.jobs.batch.jobs import plan_cohort, plan_text

    with progress_display() as progress:
        run = plan_cohort(cohort, out_dir, arm=False if no_arm else None, dry=dry_run, watcher=progress)
    finish("batch plan", run, run.summary(jobs), plan_text(run, jobs), as_json)


@batch_app.command("run")
def _run(
    out_dir: CohortOption,
    part: Annotated[str | None, Option(metavar="i/n", help="Part to run; default: SLURM's array task, or all.")] = None,
    scheduler: Annotated[
        str | None, Option(metavar="ADDRESS", help="Dask scheduler; its workers run the cases.")
    ] = None,
    jobs: JobsOption = 1,
    memory_mb: Annotated[int | None, Option(min=100, help="Memory limit of a worker, MB.")] = None,
    timeout_s: Annotated[float | None, Option(min=0.1, help="Time limit of a case, s.")] = None,
    pages: Annotated[bool, Option("--pages", help="Also draw the pictures and the page of each case.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run the cases that have no result yet. Finished cases are kept if the run is stopped."""
    from puncture_twin.planning.batch.run_case import Limits
    from puncture_twin.twin.jobs.batch.jobs import run_part, run_summary, run_text

    with progress_display() as progress:
        limits = Limits(memory_mb, timeout_s)
        counts = run_part(out_dir, part, scheduler, jobs, limits, progress, pages=pages)
    finish("batch run", counts, run_summary(out_dir, counts), run_text(out_dir, counts), as_json)


@batch_app.command("status")
def _status(out_dir: CohortOption, as_json: JsonOption = False) -> None:
    """Count done, failed, missing and stale cases. Hashes every input again."""
    from puncture_twin.planning.batch.run import cohort_state
    from puncture_twin.twin.jobs.batch.jobs import state_text

    with progress_display() as progress:
        state = cohort_state(out_dir, partial(progress.count, "cases"))
    finish("batch status", state, state.summary(), state_text(state), as_json)


@batch_app.command("merge")
def _merge(
    out_dir: CohortOption,
    expect: Annotated[Path | None, Option(metavar="FILE", help="Earlier cases.parquet; exit 1 if it differs.")] = None,
    tolerance: Annotated[
        float, Option("--tolerance-mm", min=0, help="Allowed difference of a best clearance from --expect, mm.")
    ] = 0.01,
    as_json: JsonOption = False,
) -> None:
    """Write a table, a dataset and a page of all cases. The dataset has all candidates."""
    from puncture_twin.twin.jobs.batch.jobs import merge_cohort, merge_text

    with progress_display() as progress:
        merged = merge_cohort(out_dir, expect, tolerance, progress)
    finish("batch merge", merged, merged.summary(), merge_text(merged), as_json)


@batch_app.command("compare")
def _compare(
    before: Annotated[Path, Argument(metavar="A", help="Merged cohort: its folder, or its cases.parquet.")],
    after: Annotated[Path, Argument(metavar="B", help="Another merged cohort of the same cases.")],
    as_json: JsonOption = False,
) -> None:
    """Compare two merged cohorts. Reports which cases became safe or were lost, and how far best entries moved."""
    from puncture_twin.planning.batch.merge import compare, read_cases
    from puncture_twin.twin.jobs.batch.jobs import change_summary, compare_text

    comparison = compare(read_cases(before), read_cases(after))
    summary = {"counts": dict(comparison.counts), "cases": [change_summary(one) for one in comparison.changes]}
    finish("batch compare", comparison, summary, compare_text(comparison), as_json)
