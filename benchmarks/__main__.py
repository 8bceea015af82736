"""Run all benchmarks, or those named, and write their tables into docs/results.md.

python -m benchmarks [NAME ...]    (the names are the keys of BENCHMARKS)

The page begins with what a builder reads in a minute, written by hand, and kept as it stands. Each
section follows a marker `<!-- NAME -->`. What programs printed goes to build/results/NAME.txt.
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
    independent_people,
    lens,
    mutants,
    named_measures,
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
RAW = PROJECT / "build" / "results"
BENCHMARKS: dict[str, Callable[[], str]] = {
    "independent-people": independent_people.report,
    "three-pole": full_size.three_pole,
    "four-pole": full_size.four_pole,
    "living": full_size.living,
    "skin": skin.report,
    "people": people.report,
    "named-measures": named_measures.report,
    "sigmas": sigmas.report,
    "sigmas-rigs": rig_sigmas.known,
    "sigmas-fresh": rig_sigmas.fresh,
    "fusion": fusion.report,
    "faults": faults.report,
    "fuzz": fuzz.report,
    "seconds": seconds.report,
    "costs": costs.report,
    "day": costs.day,
    "batch": costs.batch,
    "png": png.report,
    "rig": rig.report,
    "procam": procam.report,
    "charuco-ring": charuco_ring.report,
    "codes": codes.report,
    "lens": lens.report,
    "mutants": mutants.report,
}
SLOW = ("mutants", "named-measures", "day", "batch", "sigmas-rigs", "sigmas-fresh")
"""Run only when named."""


def main() -> None:
    """Run benchmarks; other sections keep the results of their last run, and say how old they are."""
    named = sys.argv[1:] or [name for name in BENCHMARKS if name not in SLOW]
    made: dict[str, str] = {}
    for name in named:
        found, load = BENCHMARKS[name]().strip(), os.getloadavg()[1]
        title, _, rest = _without_raw(name, found).partition("\n")
        made[name] = f"{title}\n\n{_origin(load)}\n{rest}"
        print(made[name], flush=True)
    sections = _sections() | made  # read now: other runs may have written meanwhile
    head = RESULTS.read_text("utf-8").split("<!-- ")[0] if RESULTS.exists() else "# Results\n\n"
    body = [
        f"<!-- {name} -->\n{_aged(name, sections[name])}\n"
        for name in BENCHMARKS
        if name in sections
    ]
    write_text(RESULTS, head + "\n".join(body))


def _without_raw(name: str, section: str) -> str:
    """A section without what programs printed, which is written to build/results/NAME.txt."""
    raw = re.findall(r"^```\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)
    if not raw:
        return section
    write_text(RAW / f"{name}.txt", "\n".join(raw))
    bare = re.sub(r"\n+(?:\w+:\n\n)?^```\n.*?^```$", "", section, flags=re.DOTALL | re.MULTILINE)
    return f"{bare.rstrip()}\n\nWhat the commands printed: `build/results/{name}.txt`."


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
        facts = dict(re.findall(r"(.+?)\s*: (.+)", Path("/proc/cpuinfo").read_text("utf-8")))
        return f"{facts['model name']} (family {facts['cpu family']})"
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
        note = f"**Older than the code**: {commits} changed it since."
        parts = [title, origin[0], note, rest.replace(origin[0], "", 1)]
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
