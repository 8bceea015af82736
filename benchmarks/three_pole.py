"""three-pole-12 at full size: simulated, calibrated, scanned, held against the truth."""

from __future__ import annotations

import re
import resource
import subprocess
import sys
import time
from pathlib import Path

PROJECT = Path(__file__).parents[1]
WORKSPACE = PROJECT / "bench" / "three-pole-12"


def report() -> str:
    """The section of docs/results.md."""
    outputs, seconds, memory = run_commands(
        PROJECT / "rigs" / "three-pole-12.yaml",
        WORKSPACE,
        PROJECT / "data" / "subjects" / "woman_average.ply",
    )
    truth = re.search(r"against the truth.*?(?=results:)", outputs["evaluate"], re.DOTALL)
    rows = "\n".join(f"| `{name}` | {seconds[name]:.1f} | {memory[name]:.1f} |" for name in outputs)
    return f"""## Three poles, twelve pairs, full size (synthetic)

`rigs/three-pole-12.yaml` simulated at 1280 x 1024, 640 stripes, mirror projectors, default noise, then
the commands a user would type. Seconds of wall clock and peak memory of each:

| command | s | GiB |
|---|---|---|
{rows}

```
{truth.group(0).rstrip() if truth else outputs["evaluate"]}
```

Calibration:

```
{outputs["calibrate-rig"].strip()}
```

Scan:

```
{outputs["scan"].strip()}
```
"""


def run_commands(
    rig: Path, workspace: Path, subject: Path
) -> tuple[dict[str, str], dict[str, float], dict[str, float]]:
    """What each command printed, how long it took (s), and its peak memory (GiB)."""
    result = workspace / "scan"
    commands = {
        "simulate": [rig, "--out", workspace, "--subject", subject],
        "calibrate-rig": [workspace / "rig.yaml"],
        "scan": [
            workspace / "captures" / "person",
            "--calibration",
            workspace / "calibration",
            "--out",
            result,
            "--overwrite",
        ],
        "export": [result, "--out", workspace / "export"],
        "evaluate": [workspace],
    }
    outputs, seconds, memory = {}, {}, {}
    for name, arguments in commands.items():
        if name == "simulate" and (workspace / "truth" / "truth.json").exists():
            continue  # the same rig gives the same bytes
        started = time.perf_counter()
        line = [sys.executable, "-m", "bodyscan", name, *map(str, arguments)]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        seconds[name] = time.perf_counter() - started
        memory[name] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        if done.returncode:
            raise SystemExit(f"{name} failed:\n{done.stdout}\n{done.stderr}")
        outputs[name] = done.stdout
    return outputs, seconds, memory
