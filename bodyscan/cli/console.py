"""What the command line shows: a bar for what takes longer than a second, times, tables."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table

from bodyscan.fusion.scan import Scan
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.verdict import Verdict

# Tables keep their lines whole when the output goes into a file.
console = Console() if sys.stdout.isatty() else Console(width=120)
errors = Console(stderr=True)


@dataclass
class StageClock:
    """Draws one bar a stage and keeps how long each took, in seconds."""

    bar: Bar
    seconds: dict[str, float] = field(default_factory=dict)
    _running: tuple[str, float] | None = None
    _tasks: dict[str, int] = field(default_factory=dict)

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.perf_counter()
        if self._running is None or self._running[0] != stage:
            self._close(now)
            self._running = (stage, now)
        if stage not in self._tasks:
            self._tasks[stage] = self.bar.add_task(stage, total=total)
        self.bar.update(self._tasks[stage], completed=done, total=total)  # type: ignore[arg-type]

    def _close(self, now: float) -> None:
        if self._running is not None:
            stage, since = self._running
            self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        self._running = None

    def finish(self) -> None:
        self._close(time.perf_counter())


@contextmanager
def stage_clock() -> Iterator[StageClock]:
    """A progress bar for the stages of one command."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Bar(*columns, TimeElapsedColumn(), console=errors) as bar:
        clock = StageClock(bar)
        try:
            yield clock
        finally:
            clock.finish()


def times_table(seconds: dict[str, float]) -> Table:
    """Seconds of each stage and of all."""
    table = Table("stage", "seconds", title="time")
    table.columns[1].justify = "right"
    for stage, taken in seconds.items():
        table.add_row(stage, f"{taken:.1f}")
    table.add_row("all", f"{sum(seconds.values()):.1f}", style="bold")
    return table


def calibration_table(calibration: RigCalibration) -> Table:
    """One row a pair: residuals, stripes, position and its sigma in the rig frame."""
    from bodyscan.geometry.placing_covariance import position_sigma

    table = Table(title=f"rig {calibration.rig.name}")
    for heading in (
        "pair",
        "corners RMS px",
        "poses",
        "light",
        "sheets RMS mm",
        "stripes",
        "position mm (x, y, z)",
        "sigma mm",
    ):
        table.add_column(heading, justify="left" if heading == "pair" else "right")
    for name, pair in calibration.pairs.items():
        quality = pair.quality
        place = calibration.rig_from_camera[name].translation
        sigma = position_sigma(calibration.covariance, name, place)
        table.add_row(
            name,
            f"{quality.corners_rms_px:.3f}",
            str(quality.poses),
            quality.light_model or "-",
            "-" if quality.planes_rms_mm is None else f"{quality.planes_rms_mm:.3f}",
            f"{quality.stripes_calibrated} of {quality.stripes_projected}"
            if pair.light is not None
            else "-",
            " ".join(f"{value:.1f}" for value in place),
            " ".join(f"{value:.3f}" for value in sigma),
        )
    for name in calibration.failed:
        table.add_row(name, "failed", *["-"] * 6, style="red")
    return table


def print_verdict(verdict: Verdict) -> None:
    """Good, usable or repeat, and the reasons."""
    style = {"good": "green", "usable": "yellow", "repeat": "red"}[verdict.grade]
    console.print(str(verdict), style=style, highlight=False, markup=False)


def scan_table(scan: Scan) -> Table:
    """What a scan gave: counts, error bars, alignment."""
    table = Table("", "", title="body model", show_header=False)
    table.columns[1].justify = "right"
    cloud, surface = scan.cloud, scan.mesh
    table.add_row("pairs measured", str(sum(points > 0 for points in scan.measured.values())))
    table.add_row("points measured by all pairs", f"{sum(scan.measured.values()):,}")
    table.add_row("points in the cloud", f"{len(cloud.points):,}")
    table.add_row("sigma of a point, median", f"{np.nanmedian(cloud.sigma_mm):.3f} mm")
    table.add_row("faces of the mesh", f"{len(surface.faces):,}")
    table.add_row("of its surface made up", f"{100.0 * surface.filled_share:.1f} %")
    if scan.alignment is not None:
        farthest = max(scan.alignment.motion_mm.items(), key=lambda item: item[1])
        before, after = scan.alignment.rms_before_mm, scan.alignment.rms_after_mm
        table.add_row("overlaps before, after alignment", f"{before:.3f}, {after:.3f} mm RMS")
        table.add_row("farthest moved", f"{farthest[0]}, {farthest[1]:.2f} mm")
        for name, sigmas in scan.alignment.refused.items():
            table.add_row("left where it was", f"{name} (asked for {sigmas:.1f} sigmas)")
    return table
