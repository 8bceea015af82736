"""Run all benchmarks, or those named, and write what they print into docs/results.md.

python -m benchmarks [NAME ...]    (the names are the keys of BENCHMARKS)
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import platform
import re
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from benchmarks import (
    charuco_ring,
    codes,
    costs,
    faults,
    full_size,
    fusion,
    fuzz,
    lens,
    motion_budget,
    mutants,
    one_solve,
    people,
    png,
    procam,
    rig,
    rig_sigmas,
    seconds,
    sigmas,
    skin,
)
from bodyscan.files.atomic import write_text

PROJECT = Path(__file__).parents[1]
RESULTS = PROJECT / "docs" / "results.md"
BENCHMARKS: dict[str, Callable[[], str]] = {
    "three-pole": full_size.three_pole,
    "four-pole": full_size.four_pole,
    "living": full_size.living,
    "skin": skin.report,
    "people": people.report,
    "motion-budget": motion_budget.report,
    "sigmas": sigmas.report,
    "sigmas-rigs": rig_sigmas.known,
    "sigmas-fresh": rig_sigmas.fresh,
    "one-solve": one_solve.report,
    "fusion": fusion.report,
    "faults": faults.report,
    "fuzz": fuzz.report,
    "seconds": seconds.report,
    "costs": costs.report,
    "day": costs.day,
    "png": png.report,
    "rig": rig.report,
    "procam": procam.report,
    "charuco-ring": charuco_ring.report,
    "codes": codes.report,
    "lens": lens.report,
    "mutants": mutants.report,
}
SLOW = ("mutants", "day", "sigmas-rigs", "sigmas-fresh", "motion-budget")
"""Run only when named."""


def main() -> None:
    """Run benchmarks; other sections keep the results of their last run, and say how old they are."""
    named = sys.argv[1:] or [name for name in BENCHMARKS if name not in SLOW]
    made: dict[str, str] = {}
    for name in named:
        found, load = BENCHMARKS[name]().strip(), os.getloadavg()[1]
        title, _, rest = found.partition("\n")
        made[name] = f"{title}\n\n{_origin(load)}\n{rest}"
        print(made[name], flush=True)
    sections = _sections() | made  # read now: other runs may have written meanwhile
    head = (
        "# Results\n\nWritten by `make bench` (`python -m benchmarks`); each section says how, when, "
        "on what and of which\ncommit it was got, and whether the code has changed since.\n"
    )
    body = [
        f"<!-- {name} -->\n{_aged(name, sections[name])}\n"
        for name in BENCHMARKS
        if name in sections
    ]
    write_text(RESULTS, "\n".join([head, *body]))


def _origin(load: float) -> str:
    """The line that says how a section was made."""
    commit = _git("rev-parse", "--short=7", "HEAD")
    changed = (
        " with changes that are not committed" if _git("status", "--porcelain", "bodyscan") else ""
    )
    machine = f"{os.cpu_count()} cores, {_processor()}, Python {platform.python_version()}"
    today = datetime.now(UTC).date().isoformat()
    return f"*Commit {commit}{changed}, {today}; {machine}; load average at its end {load:.1f}.*"


def _processor() -> str:
    """The processor's name and generation, or the instruction set if the system gives neither."""
    try:
        told = dict(re.findall(r"(.+?)\s*: (.+)", Path("/proc/cpuinfo").read_text("utf-8")))
        return f"{told['model name']} (family {told['cpu family']})"
    except (OSError, KeyError):
        return platform.machine()


_IMPORTED = re.compile(r"^\s*from benchmarks(?:\.| import )(\w+)", re.MULTILINE)
_ORIGIN = re.compile(r"^\*Commit ([0-9a-f]{7,})[^*]*\*", re.MULTILINE)
_AGE = re.compile(r"\n\*\*Older than the code\*\*[^\n]*\n")


def _measured(name: str) -> list[str]:
    """The paths whose commits make a section outdated: the package, and what its benchmark imports
    of the others."""
    found, waiting = set[str](), {BENCHMARKS[name].__module__.removeprefix("benchmarks.")}
    while waiting:
        found |= waiting
        texts = [(PROJECT / "benchmarks" / f"{one}.py").read_text("utf-8") for one in waiting]
        waiting = {one for text in texts for one in _IMPORTED.findall(text)} - found
    return ["bodyscan", *(f"benchmarks/{one}.py" for one in sorted(found))]


def _aged(name: str, section: str) -> str:
    """The section with a line on how many commits have changed what it measures, if any."""
    section = _AGE.sub("\n", section)
    title, _, rest = section.partition("\n")
    origin = _ORIGIN.search(section)
    since = (
        _git("rev-list", "--count", f"{origin[1]}..HEAD", "--", *_measured(name)) if origin else ""
    )
    if origin is None:
        parts = [title, "**Older than the code**: made before sections said of which commit.", rest]
    elif since in ("", "0"):
        parts = [title, rest]
    else:
        commits = "1 commit has" if since == "1" else f"{since} commits have"
        said = f"**Older than the code**: {commits} changed it since."
        parts = [title, origin[0], said, rest.replace(origin[0], "", 1)]
    return "\n\n".join(part.strip() for part in parts)


def _git(*arguments: str) -> str:
    """Output of git for this project; "" if it fails."""
    try:
        done = subprocess.run(
            ["git", *arguments], capture_output=True, text=True, cwd=PROJECT, check=False
        )
    except OSError:
        return ""
    return done.stdout.strip()


def _sections() -> dict[str, str]:
    if not RESULTS.exists():
        return {}
    parts = RESULTS.read_text("utf-8").split("<!-- ")[1:]
    return {name: text.strip() for name, text in (part.split(" -->\n", 1) for part in parts)}


if __name__ == "__main__":
    main()
