"""Deliberate faults, one at a time, in the mathematics and the verdicts: do the tests see them?

`make mutants`, or `python -m benchmarks.mutants [--count N] [--seed S] [MODULE ...]`. cosmic-ray makes
the mutants; a seeded sample of them, the same number of each module, is tried in copies of the
project: against the test files that are nearest to the module by what imports what, quick tests
first, then against all others of its room, up to the first test that fails. That one has to pass
without the mutant. What survives is listed, to be read: a mutant that changes nothing anyone could
notice (an equivalent one) is put down in `equivalent_mutants.txt`, with the reason; what else
survives, in `first_survivors.txt`.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from queue import SimpleQueue

from bodyscan.files.atomic import write_text

PROJECT = Path(__file__).parents[1]
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.txt")
"""Blocks of a path, the lines that differ, and `# why` nobody could notice."""
SURVIVED_FIRST = Path(__file__).with_name("first_survivors.txt")
"""Likewise those of the published sample that survived when it was drawn: tests written to find
them say nothing about faults that no sample drew, so they count as survivors for good."""
WORK = PROJECT / "build" / "mutants"
"""The copies, what Numba compiled in them, and which test found which mutant, which is tried first
next time."""
FOUND_BY = WORK / "found_by.json"
RUNS = 2
"""Mutants tried at a time, each in its own copy."""
ROOMS = (
    "geometry",
    "stripes",
    "boards",
    "calibration",
    "registration",
    "reconstruction",
    "alignment",
    "fusion",
    "mesh",
    "measurement",
    "evaluation",
)
BESIDE = (
    "bodyscan/captures/grey_levels.py",
    "bodyscan/captures/captures_file.py",
    "bodyscan/export/defacing.py",
    "bodyscan/files/hashing.py",
    "bodyscan/report/calibration_verdict.py",
    "bodyscan/verdict.py",
    "bodyscan/workflows/accept_rig.py",
    "bodyscan/workflows/check_rig.py",
)
"""Mathematics and verdicts in rooms with another purpose."""
FILES = ("__init__.py", "storage.py", "ply.py", "acceptance_file.py")
"""Neither mathematics nor verdicts: these files read, write or name things."""
OPERATORS = re.compile(
    r"core/(ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul)"
    r"|ReplaceComparisonOperator_(Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Lt_Gt|Gt_Lt|LtE_GtE|GtE_LtE|Eq_NotEq)"
    r"|ReplaceUnaryOperator_Delete_(USub|Invert|Not)|NumberReplacer|ReplaceAndWithOr|ReplaceOrWithAnd"
    r"|ReplaceTrueWithFalse|ReplaceFalseWithTrue|ZeroIterationForLoop)"
)
"""Those of cosmic-ray's operators that imitate mistakes; the others end in a TypeError."""
DECLARATION = re.compile(r"-\s*@", re.MULTILINE)
"""Lines that compute nothing: decorators."""
GUARD = re.compile(r"strict=\s*(True|False)|[*/],")
"""What zip refuses, which callers cannot pass; and the star before keyword-only arguments."""
NEAREST, FIRST = 9, 2
"""Test files tried before those of the room, and how many of them alone at first, which is cheap and
usually enough. Tests of whole sequences find much, and lie behind those of neighbouring parts."""


@dataclass(frozen=True)
class Mutant:
    """One changed file: its path in the project, its text, and the lines that differ."""

    path: str
    code: str
    change: str

    @property
    def key(self) -> str:
        return f"{self.path}\n{self.change}"


@dataclass
class Copy:
    """A copy of the project with the process that runs its tests."""

    project: Path
    cache: Path
    runner: subprocess.Popen[str]
    sound: dict[str, bool] = field(default_factory=dict)
    """For tests that failed with a mutant: whether they pass without."""


def main() -> None:
    """Print each mutant's fate as it is known, and the section for docs/results.md at the end."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=COUNT)
    options.add_argument("--seed", type=int, default=SEED)
    options.add_argument("modules", nargs="*")
    given = options.parse_args()
    print(report(given.count, given.seed, given.modules))


COUNT = 80
SEED = 79
"""Of the published sample: survivors of other seeds were examined and fixed before it was drawn."""


def report(count: int = COUNT, seed: int = SEED, modules: Sequence[str] = ()) -> str:
    """The section of docs/results.md."""
    sample = list(_sample(modules or _modules(), count, seed))
    equivalent = _blocks(EQUIVALENT)
    tried = [one for one in sample if one.key not in equivalent]
    return _section(seed, sample, tried, _fates(tried))


def _section(
    seed: int, sample: Sequence[Mutant], tried: Sequence[Mutant], fates: Mapping[str, str]
) -> str:
    """The section on a sample: those of it that are not equivalent, and which test found each."""
    first = _blocks(SURVIVED_FIRST)
    left = [one for one in tried if not fates[one.key]]
    survived = [one for one in tried if one.key in first or not fates[one.key]]
    listed = "\n\n".join(one.key for one in left)
    same, share = len(sample) - len(tried), len(survived) / max(len(tried), 1)
    places = f"{len({one.path for one in sample})} of the {len(_modules())} modules"
    since = len(survived) - len(left)
    return f"""## Deliberate faults

`make mutants`: {len(sample)} one-line faults that cosmic-ray made, drawn with seed {seed}, in {places}
of mathematics and verdicts, each against the {NEAREST} test files nearest to it and all of its room.
{same} change nothing that anyone could notice, `benchmarks/equivalent_mutants.txt` says why. Of the
{len(tried)} others **{len(survived)} survived when they were drawn, {share:.0%}.** Tests written since
find {since} of these; what still survives:

```
{listed or "nothing"}
```
"""


def _fates(mutants: Sequence[Mutant]) -> dict[str, str]:
    """The test that finds each mutant, or ""."""
    copies: SimpleQueue[Copy] = SimpleQueue()
    for number in range(RUNS):
        copies.put(_copy(WORK / str(number)))
    found = json.loads(FOUND_BY.read_text("utf-8")) if FOUND_BY.exists() else {}

    def fate(mutant: Mutant) -> str:
        copy = copies.get()
        try:
            test = _found_by(mutant, copy, found.get(mutant.key, ""))
        finally:
            copies.put(copy)
        said = f"found by {test}" if test else "survived"
        print(f"{said}: {mutant.key}\n", file=sys.stderr, flush=True)
        return test

    fates: dict[str, str] = {}
    with ThreadPoolExecutor(RUNS) as pool:
        for mutant, test in zip(mutants, pool.map(fate, mutants), strict=True):
            fates[mutant.key] = test
            write_text(FOUND_BY, json.dumps(found | fates, indent=1))
    for _ in range(RUNS):
        copies.get().runner.communicate()
    return fates


def _modules() -> list[str]:
    rooms = [path for room in ROOMS for path in sorted((PROJECT / "bodyscan" / room).rglob("*.py"))]
    found = [path.relative_to(PROJECT).as_posix() for path in rooms if path.name not in FILES]
    return [*found, *BESIDE]


def _sample(modules: Sequence[str], count: int, seed: int) -> Iterator[Mutant]:
    """The same number from each module; the draw from one does not depend on the others."""
    draws = {path: random.Random(f"{seed} {path}") for path in modules}
    order = sorted(modules, key=lambda path: draws[path].random())
    waiting = {path: _mutants(path, draws[path]) for path in order}
    left = count
    while left and waiting:
        for path in list(waiting):
            mutant = next(waiting[path], None)
            if mutant is None:
                del waiting[path]
                continue
            yield mutant
            left -= 1
            if not left:
                return


def _mutants(path: str, rng: random.Random) -> Iterator[Mutant]:
    """Mutants of one module, shuffled."""
    # cosmic-ray imports parts of parso in an order that breaks parso 0.8.7.
    import parso.python.tree
    import parso.tree  # noqa: F401
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    source = (PROJECT / path).read_text("utf-8")
    nodes = list(ast_nodes(get_ast(source)))
    places = []
    for name in filter(OPERATORS.fullmatch, operator_names()):
        operator = get_operator(name)()
        found = sum(1 for node in nodes for _ in operator.mutation_positions(node))
        places += [(operator, occurrence) for occurrence in range(found)]
    rng.shuffle(places)
    for operator, occurrence in places:
        code = mutate_code(source, operator, occurrence)
        if code is None or GUARD.sub("", code) == GUARD.sub("", source):
            continue
        change = _difference(source, code)
        if not DECLARATION.match(change):
            yield Mutant(path, code, change)


def _difference(before: str, after: str) -> str:
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm="")
    return "\n".join(line for line in lines if line[:1] in "+-" and line[:3] not in ("+++", "---"))


def _blocks(path: Path) -> set[str]:
    """Keys of the mutants that a file lists; lines that begin with # are for readers."""
    blocks = path.read_text("utf-8").split("\n\n") if path.exists() else []
    return {
        "\n".join(line for line in block.strip().splitlines() if not line.startswith("#"))
        for block in blocks
    }


def _copy(folder: Path) -> Copy:
    """Copy the project, including file dates: what was compiled in the last copy remains valid."""
    project, cache, logs = (folder / name for name in ("project", "compiled", "logs"))
    shutil.rmtree(project, ignore_errors=True)
    for path in (cache, logs):
        path.mkdir(parents=True, exist_ok=True)
    ignored = shutil.ignore_patterns("__pycache__")
    for name in (
        "bodyscan",
        "benchmarks",
        "tests",
        "examples",
        "rigs",
        "pipelines",
        "data",
        "docs",
    ):
        shutil.copytree(PROJECT / name, project / name, symlinks=True, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md"):
        shutil.copy2(PROJECT / name, project)
    runner = subprocess.Popen(
        [sys.executable, str(project / "benchmarks" / "mutant_runner.py"), str(logs)],
        cwd=project,
        env=_environment(project),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    return Copy(project, cache, runner)


def _environment(project: Path) -> dict[str, str]:
    captures = os.environ.get("BODYSCAN_CAPTURES", str(PROJECT.parent / "shared" / "captures"))
    return os.environ | {"PYTHONPATH": str(project), "BODYSCAN_CAPTURES": captures, "CI": "true"}


def _found_by(mutant: Mutant, copy: Copy, hint: str) -> str:
    """The first test that fails with the mutant in place and passes without it; "" if none does.

    hint: the test that found it in an earlier run is tried first, "" if there is none.
    """
    tests = _tests_of(mutant.path)
    if not tests:
        return ""
    others = _others_of_room(mutant.path, tests)
    with _in_place(mutant, copy) as cache:
        failed = (
            (hint and _first_failure([hint], True, cache, copy))
            or _first_failure(tests[:FIRST], False, cache, copy)
            or _first_failure(tests[FIRST:], False, cache, copy)
            or _first_failure(tests, True, cache, copy)
            or _first_failure(others, True, cache, copy)
        )
    if failed and failed not in copy.sound:
        copy.sound[failed] = not _first_failure([failed], True, copy.cache, copy)
    if failed and not copy.sound[failed]:
        raise SystemExit(f"this test fails without any mutant: {failed}")
    return failed


@contextmanager
def _in_place(mutant: Mutant, copy: Copy) -> Iterator[Path]:
    """Put the mutant into its file; yields the folder for what Numba compiles meanwhile.

    Numba's caches of callers do not notice changes in callees, so files that import the mutant
    count as new. Afterwards all dates are restored, and what was compiled before is valid again.
    """
    callers = [copy.project / path for path in _compiled_importers(mutant.path)]
    place = copy.project / mutant.path
    stamps = {one: one.stat() for one in {place, *callers}}
    source = place.read_text("utf-8")
    cache = copy.cache
    if callers:
        cache = copy.cache.with_name("compiled-mutant")
        shutil.rmtree(cache, ignore_errors=True)  # of an interrupted run
        shutil.copytree(copy.cache, cache, copy_function=os.link)
    try:
        place.write_text(mutant.code, "utf-8")
        for one in callers:
            one.touch()
        yield cache
    finally:
        place.write_text(source, "utf-8")
        for one, stamp in stamps.items():
            os.utime(one, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        if callers:
            shutil.rmtree(cache)


def _first_failure(tests: Sequence[str], slow: bool, cache: Path, copy: Copy) -> str:
    if not tests:  # pytest would try all that there are
        return ""
    assert copy.runner.stdin
    assert copy.runner.stdout
    print(
        json.dumps({"tests": list(tests), "slow": slow, "cache": str(cache)}),
        file=copy.runner.stdin,
        flush=True,
    )
    failed: str = json.loads(copy.runner.stdout.readline())
    return failed


@lru_cache
def _imports() -> dict[str, frozenset[str]]:
    """For each file of the package and the tests, which of
    these files it imports; project paths."""
    files = [one for name in ("bodyscan", "tests") for one in (PROJECT / name).rglob("*.py")]
    named = {}
    for one in files:
        path = one.relative_to(PROJECT).as_posix()
        inside = path.removeprefix("tests/support/") if path.startswith("tests/") else path
        named[inside.removesuffix(".py").removesuffix("/__init__").replace("/", ".")] = path
    found = {}
    for path in named.values():
        wanted: set[str] = set()
        for node in ast.walk(ast.parse((PROJECT / path).read_text("utf-8"))):
            if isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                wanted |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
        if "pkgutil" in wanted and path.endswith("__init__.py"):  # takes what lies beside it
            folder = Path(path).parent
            wanted |= {one for one, place in named.items() if Path(place).parent == folder}
        found[path] = frozenset(named[one] for one in wanted if one in named) - {path}
    return found


@lru_cache
def _tests_of(path: str) -> tuple[str, ...]:
    """The test files nearest to a module by imports, those of other rooms a step farther; of
    equally near ones first those named like it, then those that import least besides."""
    imports = _imports()
    distance, step, reached = {path: 0}, 0, {path}
    while reached:
        step += 1
        reached = {one for one, needs in imports.items() if needs & reached and one not in distance}
        distance |= dict.fromkeys(reached, step)
    room, name = Path(path).parts[1], Path(path).stem
    tests = [Path(one) for one in distance if Path(one).name.startswith("test_")]

    def place(test: Path) -> tuple[object, ...]:
        own = test.as_posix()
        steps = distance[own] + (test.parts[1] != room)
        return steps, name not in test.stem, len(imports[own]), own

    return tuple(one.as_posix() for one in sorted(tests, key=place)[:NEAREST])


def _others_of_room(path: str, tests: Sequence[str]) -> list[str]:
    """The test files of a module's room that are not among `tests`."""
    room = (PROJECT / "tests" / Path(path).parts[1]).glob("test_*.py")
    return sorted({one.relative_to(PROJECT).as_posix() for one in room} - set(tests))


@lru_cache
def _compiled_importers(path: str) -> tuple[str, ...]:
    """Files with compiled functions that call a module's, including itself if it has any."""
    imports = _imports()

    def compiles(one: str) -> bool:
        return "bodyscan/compiled.py" in imports[one]

    if not compiles(path):
        return ()
    found = {path}
    while True:
        more = {one for one, needs in imports.items() if needs & found and compiles(one)}
        if more <= found:
            return tuple(sorted(found))
        found |= more


if __name__ == "__main__":
    main()
