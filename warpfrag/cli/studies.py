"""`warpfrag fit --all`: whole studies, one after the other, and the report of them."""

from pathlib import Path

import typer

from warpfrag.cli.options import UsageError
from warpfrag.cli.streams import complain


def run_studies(study: Path | None, source: Path | None, output: Path | None) -> None:
    """Run a study's folder, or all, and write the report; status 1 if a study failed.

    Args:
        study: the folder of one study; None runs all.
        source: folder of all studies; None takes the usual one.
        output: folder of the report; None takes the usual one.
    """
    from warpfrag.studies.report import duration, write_gallery
    from warpfrag.studies.runner import LOG, SCRIPT, STUDIES, display, find_studies, run_study
    from warpfrag.studies.summary import RESULTS

    if study is None:
        folders, target = find_studies(source or STUDIES), output or RESULTS
    elif (study / SCRIPT).is_file():
        folders, target = [study], output or RESULTS / study.resolve().name
    else:
        raise UsageError(f"{study}: got no {SCRIPT} in it, expected a study's folder or a study file")
    # That it cannot be written is to be known before the studies have run.
    target.mkdir(parents=True, exist_ok=True)
    runs = []
    for number, folder in enumerate(folders, start=1):
        words = f"{folder.resolve().name} ({number} of {len(folders)})"
        try:
            with display(words) as show:
                run = run_study(folder, show)
        except KeyboardInterrupt:
            raise typer.Exit(complain(f"stopped in {words}; the report is not written", 130)) from None
        runs.append(run)
        if run.summary is not None:
            print(f"{run.name}: {run.summary.headline} ({duration(run.seconds)})")
        else:
            complain(f"{run.name}: {run.error} (more in {RESULTS / run.name / LOG})", 1)
    shown = write_gallery(runs, target / "report.html")
    for run, before in zip(shown, runs, strict=True):
        if run is not before:
            complain(f"{run.name}: {run.error}", 1)
    print(f"report in {target / 'report.html'}")
    if any(run.error for run in shown):
        raise typer.Exit(1)
