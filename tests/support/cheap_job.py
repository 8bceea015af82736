"""Jobs whose stages take no time, so that tests can look at what goes on around them.

`python cheap_job.py FOLDER` is the job's process; `python cheap_job.py batch SCANS OUT [WORKERS]` a
whole batch.  What a stage does is written in the scan's folder, in `do.txt`.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
import time
from pathlib import Path

from bodyscan.errors import BodyscanError
from bodyscan.jobs.job import Job
from bodyscan.jobs.stages import Stage, list_results_of
from bodyscan.jobs.worker import main
from bodyscan.progress import Progress
from bodyscan.verdict import Announce, Verdict

COMMAND = (__file__,)
PIPELINE = Path(__file__).parents[2] / "pipelines" / "fuse.yaml"


def inputs(job: Job) -> dict[str, Path]:
    return {path.name: path for path in sorted(job.source.iterdir())}


def scan(job: Job, out: Path, progress: Progress, announce: Announce) -> None:
    """Two files made slowly from what lies in the scan's folder; or what `do.txt` says."""
    text = "".join(path.read_text() for path in sorted(job.source.iterdir()))
    seed = f"{text} {job.pipeline.fusion.points}".encode()
    for number in range(2):
        progress("making", number, 2)
        (out / f"{number}.bin").write_bytes(hashlib.sha256(seed).digest() * 2000)
        seed += b"."
        _do(job)
    announce(Verdict("good"), final=True)
    print("made a scan", flush=True)


def export(job: Job, out: Path, progress: Progress, announce: Announce) -> None:
    _, *rest = sorted((job.folder / "scan").glob("*.bin"))
    (out / "body.bin").write_bytes(rest[0].read_bytes()[::-1])
    time.sleep(0.02)
    print("made an export", flush=True)


def _do(job: Job) -> None:
    words = (job.source / "do.txt").read_text().split()
    if words[0] == "sleep":
        time.sleep(float(words[1]))
    elif words[0] == "crash":
        ctypes.string_at(0)
    elif words[0] == "exit":
        os._exit(3)
    elif words[0] == "raise":
        raise ValueError("a bad day")
    elif words[0] == "fill":
        (job.folder / "filling").write_bytes(bytes(int(words[1])))
    elif words[0] == "change":
        (job.source / "more.txt").write_text(str(time.time()))
    elif words[0] == "once" and not (job.folder / "was here").exists():
        (job.folder / "was here").touch()
        os._exit(1)


def kinds(scan_version: int = 1) -> dict[str, tuple[Stage, ...]]:
    made = Stage("scan", scan_version, ("fusion",), inputs, scan)
    return {"fuse": (made, Stage("export", 1, ("export",), list_results_of("scan"), export))}


def batch(scans: Path, out: Path, workers: int) -> int:
    # As in the package, a job's own process does not load what hands jobs out.
    from bodyscan.jobs.batch import Allocation, finish, run_batch, run_locally
    from bodyscan.jobs.display import print_json_lines
    from bodyscan.jobs.job import find_jobs
    from bodyscan.jobs.pipeline import load_pipeline

    pipeline = load_pipeline(PIPELINE)
    jobs = find_jobs(pipeline, scans, out, scans, "export")
    with print_json_lines() as listen:
        run = run_locally(Allocation(workers, 1, ""), COMMAND, listen)
        outcomes = run_batch(jobs, out, run, listen)
        listen(finish(jobs, outcomes, out))
    return int(any(outcome.state != "done" for outcome in outcomes))


if __name__ == "__main__":
    if sys.argv[1] == "batch":
        try:
            sys.exit(batch(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4])))
        except (BodyscanError, OSError) as error:  # as bodyscan.cli.main does
            print(f"error: {error}", file=sys.stderr)
            sys.exit(getattr(error, "exit_code", 1))
    sys.exit(main(kinds()))
