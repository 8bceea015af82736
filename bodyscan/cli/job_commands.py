"""The commands `batch`, `verify` and `forget`."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from bodyscan.errors import BadInput, FailedWork

if TYPE_CHECKING:
    from bodyscan.jobs.job import Job
    from bodyscan.jobs.object_storage import Store
    from bodyscan.jobs.stages import Stage


def register(app: typer.Typer) -> None:
    """Add this module's commands to the command line."""
    for command in (batch, verify, forget):
        app.command()(command)


def batch(
    pipeline: Annotated[Path, typer.Argument(metavar="PIPELINE.YAML", help="See pipelines/.")],
    scans: Annotated[str, typer.Option(help="Folder (or URL) of scan folders, or of rigs.")],
    out: Annotated[str, typer.Option(help="Folder (or URL) for a job folder of each.")],
    calibration: Annotated[
        str | None,
        typer.Option(help="Default: `calibration` in the folder of scans, beside or above it."),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Such as fusion.points=2000000."),
    ] = None,
    until: Annotated[str | None, typer.Option(metavar="STAGE", help="The last stage.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Jobs at the same time.")] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="A dask scheduler to send to.")
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="Say why each stage would run; do nothing.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Events as lines of JSON.")] = False,
) -> None:
    """Fuse every scan of a day (or calibrate every rig), each in a process of its own."""
    from bodyscan.jobs.discovery import find_jobs
    from bodyscan.jobs.object_storage import Store, find_stored_jobs, is_url
    from bodyscan.jobs.pipeline import load_pipeline
    from bodyscan.jobs.stages import KINDS, stages_until

    settings = load_pipeline(pipeline, changes or ())
    every = KINDS[settings.kind]
    last = until or every[-1].name
    stages = stages_until(every, last)
    if not is_url(scans) and not is_url(out):
        folder, given = Path(out), Path(calibration) if calibration else None
        jobs = find_jobs(settings, Path(scans), folder, given, last)
        if explain:
            _explain(jobs, stages)
            return
        if folder.exists() and not folder.is_dir():
            raise BadInput("is a file; jobs go into a folder", where=out)
        raise typer.Exit(_run(jobs, folder, workers, cluster, json))
    fuses = settings.kind == "fuse"
    if explain or not (is_url(scans) and is_url(out)) or (fuses and not is_url(calibration or "")):
        raise BadInput(
            "of scans, output and calibration either all lie in object storage or none; "
            "--explain is for folders",
            where=f"{scans}, {out}, {calibration}",
            remedy="give a URL to each of --scans, --out and --calibration",
        )
    store = Store(scans, out, calibration if fuses else None)
    with TemporaryDirectory(prefix="bodyscan-") as outline:
        jobs = find_stored_jobs(store, settings, last, Path(outline))
        raise typer.Exit(_run(jobs, Path(outline) / "out", workers, cluster, json, store))


def _explain(jobs: Sequence[Job], stages: Sequence[Stage]) -> None:
    from concurrent.futures import ThreadPoolExecutor

    from bodyscan.jobs.job import printable
    from bodyscan.jobs.plan import plan

    with ThreadPoolExecutor() as pool:
        for job, steps in zip(jobs, pool.map(lambda job: plan(job, stages), jobs), strict=True):
            for step in steps:
                said = f"will run: {step.why}" if step.why else "up to date"
                typer.echo(printable(f"{job.name}: {step.stage}: {said}"))


def _run(
    jobs: Sequence[Job],
    out: Path,
    workers: int | None,
    cluster: str | None,
    json: bool,
    store: Store | None = None,
) -> int:
    """Returns the exit code: 1 if a job was set aside, or a scan has to be repeated."""
    from bodyscan.jobs import allocation, display, object_storage
    from bodyscan.jobs.batch import finish, run_batch, run_locally
    from bodyscan.jobs.cluster import run_on_cluster
    from bodyscan.jobs.supervision import supervise_job

    resources = jobs[0].pipeline.resources
    shares = allocation.allocate(
        resources, len(jobs), workers, allocation.cores(), allocation.free_memory_mb()
    )
    work = partial(object_storage.work_on_stored, store=store) if store else supervise_job
    try:
        with display.json_lines() if json else display.screen() as listen:
            if cluster:
                run = run_on_cluster(cluster, resources.threads, listen=listen, work=work)
            else:
                listen({"event": "shares", **asdict(shares)})
                run = run_locally(shares, listen=listen, work=work)
            outcomes = run_batch(jobs, out, run, listen)
            if store:
                object_storage.fetch_figures(jobs, store)
            summary = finish(jobs, outcomes, out)
            if store:
                summary |= {"table": object_storage.put_summary(out, store)}
            listen(summary)
    except KeyboardInterrupt:
        sys.stdout.flush()
        typer.secho("stopped; the same command goes on from here", err=True)
        os._exit(130)  # the jobs' processes end with this one
    return 1 if summary["set_aside"] or summary["repeat"] else 0


def verify(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="--out of a batch, or a job.")],
) -> None:
    """Hold images, calibration and results against the manifest; find any byte that changed."""
    from bodyscan.jobs.job import printable
    from bodyscan.jobs.verification import verify as look

    verified = look(folder)
    for fault in verified.faults:
        typer.echo(printable(fault))
    if verified.faults:
        raise FailedWork(
            f"{len(verified.faults)} of {verified.files} files are not as they were",
            where=str(folder),
            remedy="restore them, or start the batch again: it makes anew what was touched",
        )
    typer.echo(f"{verified.files} files, every byte as it was")


def forget(
    subject: Annotated[str, typer.Argument(metavar="SUBJECT", help="The pseudonym.")],
    workspace: Annotated[Path, typer.Option(help="Folder to look through.")] = Path(),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would go; remove nothing.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask first.")] = False,
) -> None:
    """Remove every file of a subject: images, jobs, results, exports, rows of summaries."""
    from bodyscan.jobs import forgetting
    from bodyscan.jobs.job import printable

    found = forgetting.find_subject(subject, workspace)
    if not dry_run:
        if sys.stdin.isatty() and not yes and found.files:
            typer.confirm(f"remove {len(found.files)} files of {subject} for ever?", abort=True)
        found = forgetting.forget_subject(subject, workspace)
    verb = "would remove" if dry_run else "removed"
    for path in found.files:
        typer.echo(f"{verb} {printable(str(path))}")
    for path in found.unreadable:
        typer.secho(f"cannot tell whose: {printable(str(path))}", fg="yellow", err=True)
    typer.echo(f"{verb} {len(found.files)} files of {subject}")
