"""Which stages have to run again, and why: results are compared with what they would be made from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from bodyscan.files.hashing import hash_files
from bodyscan.jobs.job import STAGE, STATE, Job, list_results_in, read_record
from bodyscan.jobs.stages import Stage


@dataclass(frozen=True)
class Origin:
    """Everything that a stage's results depend on. inputs: SHA-256 of every file it reads."""

    stage: str
    stage_version: int
    settings: dict[str, Any]
    inputs: dict[str, str]

    def record(self, outputs: Mapping[str, str]) -> dict[str, Any]:
        """Content of stage.json: without time or folder, so that the same work gives the same bytes."""
        heading = {"schema": "bodyscan-stage", "version": 1}
        return heading | asdict(self) | {"outputs": dict(outputs)}


def describe_origin(job: Job, stage: Stage) -> Origin:
    """Origin of a stage if it ran now. Raises BodyscanError or OSError for unreadable inputs."""
    settings = {name: job.pipeline.section(name) for name in stage.sections}
    return Origin(stage.name, stage.version, settings, hash_files(stage.inputs(job)))


def find_reason_to_run(job: Job, now: Origin) -> str:
    """Why a stage has to run; "" if its results were made from exactly this, and are complete."""
    folder = job.folder / now.stage
    try:
        record = json.loads((folder / STAGE).read_text("utf-8"))
        version, settings = record["stage_version"], record["settings"]
        inputs, outputs = dict(record["inputs"]), dict(record["outputs"])
    except FileNotFoundError:
        reason = read_record(job.folder / STATE).get("reason")
        return f"it failed last time: {reason}" if reason else "there is no result yet"
    except (OSError, ValueError, KeyError, TypeError):
        return "what its last result was made from cannot be read"
    if version != now.stage_version:
        return f"version {now.stage_version} of the stage, it was {version}"
    if changes := _list_changes(settings, now.settings):
        return f"settings changed: {changes}"
    if changes := _list_difference(inputs, now.inputs):
        return f"inputs changed: {changes}"
    if changes := _list_difference(outputs, hash_files(list_results_in(folder))):
        return f"its result was changed: {changes}"
    return ""


def _list_difference(was: Mapping[str, str], now: Mapping[str, str]) -> str:
    """List which files changed, came or went, the first three by name."""
    changes = [
        *(f"{name} has other content" for name in was if name in now and was[name] != now[name]),
        *(f"{name} is new" for name in now if name not in was),
        *(f"{name} is gone" for name in was if name not in now),
    ]
    more = [f"and {len(changes) - 3} more"] if len(changes) > 3 else []
    return ", ".join([*changes[:3], *more])


def _list_changes(was: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """List the settings that differ, by section and key, with both values."""
    before, after = (
        {f"{name}.{key}": value for name, each in sections.items() for key, value in each.items()}
        for sections in (was, now)
    )
    return ", ".join(
        f"{key} {json.dumps(before.get(key))} -> {json.dumps(after.get(key))}"
        for key in sorted({*before, *after})
        if before.get(key) != after.get(key)
    )
