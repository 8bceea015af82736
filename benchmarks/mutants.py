"""Deliberate faults, one at a time, in the mathematics and the verdicts: do the tests see them?

`make mutants`, or `python -m benchmarks.mutants [--count N] [--seed S] [MODULE ...]`. cosmic-ray makes
the mutants, in a copy of the project; a seeded sample of them, the same number of each module, is run
against the quick tests of the module. What survives is listed, to be read: a mutant that changes
nothing (an equivalent one) is put down in `equivalent_mutants.txt`, with the reason.
"""

from __future__ import annotations

import argparse
import difflib
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

PROJECT = Path(__file__).parents[1]
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.txt")
ROOMS = ("geometry", "calibration", "registration", "reconstruction", "alignment", "fusion")
VERDICTS = ("bodyscan/evaluation/artefacts.py", "bodyscan/evaluation/planes.py")
OPERATORS = re.compile(
    r"core/(ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul)"
    r"|ReplaceComparisonOperator_(Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Lt_Gt|Gt_Lt|LtE_GtE|GtE_LtE|Eq_NotEq)"
    r"|ReplaceUnaryOperator_Delete_(USub|Invert|Not)|NumberReplacer|ReplaceAndWithOr|ReplaceOrWithAnd"
    r"|ReplaceTrueWithFalse|ReplaceFalseWithTrue|ZeroIterationForLoop)"
)
"""Of cosmic-ray's operators those that one might write by mistake; the others end in a TypeError."""
PATIENCE = 4.0
"""A mutant that takes so many times as long as the tests took without it hangs: it is found out."""


@dataclass(frozen=True)
class Mutant:
    """One changed file: its path in the project, its text, and the lines that differ."""

    path: str
    code: str
    change: str


def main() -> None:
    """Prints each survivor as it is found, and the section for docs/results.md at the end."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=100)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("modules", nargs="*")
    given = options.parse_args()
    print(report(given.count, given.seed, given.modules))


def report(count: int = 100, seed: int = 0, modules: Sequence[str] = ()) -> str:
    """The section of docs/results.md."""
    known = _equivalent()
    fates: dict[str, list[Mutant]] = {"killed": [], "equivalent": [], "survived": []}
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "project"
        _copy(copy)
        for mutant in _sample(modules or _modules(), count, random.Random(seed)):
            if mutant.change in known.get(mutant.path, ()):
                fate = "equivalent"
            else:
                fate = "survived" if _survives(mutant, copy) else "killed"
            fates[fate].append(mutant)
            print(f"{fate}: {mutant.path}\n{mutant.change}", file=sys.stderr, flush=True)
    tried = len(fates["killed"]) + len(fates["survived"])
    share = len(fates["survived"]) / max(tried, 1)
    survivors = "\n\n".join(f"{own.path}\n{own.change}" for own in fates["survived"])
    return f"""## Deliberate faults

`make mutants`: {tried} one-line faults (seed {seed}; {len(fates["equivalent"])} more change nothing)
in the mathematics and the verdicts, each against the quick tests of its module.
**{len(fates["survived"])} survived, {share:.0%}.**

```
{survivors}
```
"""


def _modules() -> list[str]:
    rooms = [path for room in ROOMS for path in sorted((PROJECT / "bodyscan" / room).glob("*.py"))]
    found = [path.relative_to(PROJECT).as_posix() for path in rooms]
    return [path for path in (*found, *VERDICTS) if not path.endswith("__init__.py")]


def _sample(modules: Sequence[str], count: int, rng: random.Random) -> Iterator[Mutant]:
    """As many of each module, in an order that does not depend on the others."""
    order = list(modules)
    rng.shuffle(order)
    waiting = {path: _mutants(path, rng) for path in order}
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
    """Those of one module, shuffled."""
    # cosmic-ray imports parts of parso in an order that parso 0.8.7 does not bear.
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
        if code is not None and code != source:
            yield Mutant(path, code, _difference(source, code))


def _difference(before: str, after: str) -> str:
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm="")
    return "\n".join(line for line in lines if line[:1] in "+-" and line[:3] not in ("+++", "---"))


def _equivalent() -> dict[str, set[str]]:
    """By path, the changes known to change nothing: blocks of a path, its lines, and `# why`."""
    known: dict[str, set[str]] = {}
    for block in EQUIVALENT.read_text("utf-8").split("\n\n") if EQUIVALENT.exists() else []:
        path, *lines = [line for line in block.splitlines() if not line.startswith("#")] or [""]
        known.setdefault(path, set()).add("\n".join(lines))
    return known


def _copy(copy: Path) -> None:
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
        shutil.copytree(PROJECT / name, copy / name, symlinks=True)
    shutil.copy(PROJECT / "pyproject.toml", copy)


def _survives(mutant: Mutant, copy: Path) -> bool:
    """Whether the tests pass with the mutant in place; it is taken away again."""
    tests = _tests_of(mutant.path, copy)
    if not tests:
        return True
    usual_s = _usual_seconds(tests, copy)
    place = copy / mutant.path
    source = place.read_text("utf-8")
    try:
        place.write_text(mutant.code, "utf-8")
        _compile_again(mutant.path, copy)
        return _run(tests, copy, PATIENCE * usual_s + 10.0)[0]
    finally:
        place.write_text(source, "utf-8")
        _compile_again(mutant.path, copy)


@lru_cache
def _usual_seconds(tests: tuple[str, ...], copy: Path) -> float:
    """How long the tests take without any mutant. Raises SystemExit where they fail."""
    passed, seconds = _run(tests, copy, None)
    if not passed:
        raise SystemExit(f"these tests fail without any mutant: {' '.join(tests)}")
    return seconds


def _tests_of(path: str, copy: Path) -> tuple[str, ...]:
    """Test files of the module's room that import it; else all that do; else all of its room."""
    name = re.compile(rf"\b{re.escape(path.removesuffix('.py').replace('/', '.'))}\b")
    room = sorted((copy / "tests" / Path(path).parts[1]).glob("test_*.py"))
    every = sorted((copy / "tests").rglob("test_*.py"))
    naming = [
        [one for one in tests if name.search(one.read_text("utf-8"))] for tests in (room, every)
    ]
    own = naming[0] or naming[1] or room
    return tuple(str(one.relative_to(copy)) for one in own)


def _compile_again(path: str, copy: Path) -> None:
    """Numba's caches of callers know nothing of what they call: files that import it count as new."""
    module = path.removesuffix(".py").replace("/", ".")
    for other in (copy / "bodyscan").rglob("*.py"):
        if f"from {module} import" in other.read_text("utf-8"):
            other.touch()


def _run(tests: Sequence[str], copy: Path, limit_s: float | None) -> tuple[bool, float]:
    started = time.monotonic()
    line = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider"]
    try:
        done = subprocess.run(
            [*line, "-p", "no:xdist", *tests],
            cwd=copy,
            env=_environment(copy),
            capture_output=True,
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False, limit_s or 0.0
    return done.returncode == 0, time.monotonic() - started


def _environment(copy: Path) -> dict[str, str]:
    captures = os.environ.get("BODYSCAN_CAPTURES", str(PROJECT.parent / "shared" / "captures"))
    return os.environ | {"PYTHONPATH": str(copy), "BODYSCAN_CAPTURES": captures, "CI": "true"}


if __name__ == "__main__":
    main()
