"""``aenerf report``: a page that explains one run, or compares several."""

from __future__ import annotations

import csv
import gc
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from aenerf_ns.cli.console import say
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import creating, require_run, require_writable

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from aenerf_ns.report.comparison import Protocol
    from aenerf_ns.report.measuring import RunReport


@dataclass
class ReportCommand:
    """Measure trained runs and write report.html, one page that opens without a network, with views.csv and
    report.json beside it. Several runs are compared view by view."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """The runs: each by its config.yml or its folder."""
    output: Path = Path("report")
    """Folder to write to. Files of an earlier report there are replaced."""
    allow_different_protocols: bool = False
    """Compare runs although they were measured differently. The page then says how."""
    data: Path | None = None
    """Where the dataset of the runs is now, if it was moved: one dataset for all runs."""

    def main(self) -> None:
        """Measure the runs and write the page."""
        if not self.runs:
            raise DataError("aenerf report", "no run is given", "name the folder or the config.yml of one or more")
        require_writable(self.output / "report.html")
        for run in self.runs:
            require_run(run)
        from aenerf_ns.report import comparison
        from aenerf_ns.report.measuring import measure_run
        from aenerf_ns.report.page import make_page
        from aenerf_ns.report.sections import VIEW_COLUMNS, view_rows

        # Measuring takes long, and only one run at a time is sure to fit in the memory. So the runs are opened twice.
        configs: list[TrainerConfig] = []
        protocols: list[Protocol] = []
        for run in self.runs:
            config, opened_run, _ = open_run(run, self.data)
            configs.append(config)
            protocols.append(comparison.read_protocol(opened_run))
            del opened_run
            gc.collect()
        if self.data is not None and len({config.__dict__["data_at_training"] for config in configs}) > 1:
            problem = "--data names one dataset, but the runs were trained on several"
            raise DataError("aenerf report", problem, "leave it out, and link the datasets to where they were")
        names = _names(configs)
        mixed = comparison.protocol_differences(names, protocols)
        if mixed and not self.allow_different_protocols:
            problem = f"the runs are measured differently: {'; '.join(mixed)}"
            raise DataError("aenerf report", problem, "evaluate both alike, or give --allow-different-protocols")
        shared = comparison.shared_views(protocols)
        reports: list[RunReport] = []
        for run, name in zip(self.runs, names, strict=True):
            config, opened_run, _ = open_run(run, self.data)
            # The views of the first run, so that the same ones are beside each other.
            shown = reports[0].chosen if reports and shared else None
            reports.append(measure_run(name, config, opened_run, shared, shown))
            del opened_run
            gc.collect()
        paired = comparison.paired_differences(reports, shared)
        left_out = comparison.views_left_out(reports, shared)
        page = make_page(reports, paired, left_out, mixed, shared)
        figures = {
            "runs": [report.as_json() for report in reports],
            "paired_differences": paired,
            "views_not_in_all_runs": left_out,
            "protocol_differences": mixed,
        }
        with creating(self.output / "views.csv") as path, path.open("w", encoding="utf8", newline="") as file:
            table = csv.DictWriter(file, ("run", "file", *VIEW_COLUMNS), lineterminator="\n")
            table.writeheader()
            table.writerows(view_rows(reports))
        with creating(self.output / "report.json") as path:
            path.write_text(json.dumps(figures, indent=1) + "\n", "utf8")
        with creating(self.output / "report.html") as path:
            path.write_text(page, "utf8")
        size = len(page.encode()) / 1e6
        say(f"{self.output / 'report.html'}: {size:.1f} MB, with views.csv and report.json.")


def _names(configs: Sequence[TrainerConfig]) -> list[str]:
    """Name the runs apart, as shortly as that allows."""
    parts = [(config.experiment_name, config.method_name, config.timestamp) for config in configs]
    for chosen in ((0,), (1,), (0, 1), (2,), (0, 1, 2)):
        names = ["/".join(str(part[index]) for index in chosen) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{number}: {'/'.join(map(str, part))}" for number, part in enumerate(parts, start=1)]
