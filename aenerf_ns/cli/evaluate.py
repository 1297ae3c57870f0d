"""``aenerf evaluate``: the metrics of ``ns-eval``, under the run's color correction or another one."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from aenerf_ns.cli.console import say
from aenerf_ns.cli.trained_run import RunCommand, open_run
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import creating, output_error, require_absent, require_writable
from aenerf_ns.method.color_protocol import ColorCorrectionProtocol


@dataclass
class Evaluate(RunCommand):
    """Compare a trained run's renderings with the test views, as ns-eval does and in the same JSON layout, optionally
    under another protocol than the run's. Nothing in the run's folder changes."""

    output: Path
    """JSON file to write."""
    color_correction: ColorCorrectionProtocol | None = None
    """Fit this color correction on the run's data and use it; by default the correction stored with the run."""
    render_output: Path | None = None
    """Folder for pictures, from the test poses as placed: truth beside reconstruction, accumulation, depth."""
    nerfbaselines: Path | None = None
    """Folder to create in the layout of nerfbaselines: results.json, and the predictions that `nerfbaselines evaluate`
    reads, from the test poses as placed."""

    def main(self) -> None:
        """Load the run, evaluate it and write the metrics."""
        require_writable(self.output)
        if self.render_output is not None:
            require_writable(self.render_output / "0000.png", "--render-output")
        if self.nerfbaselines is not None:
            require_absent(self.nerfbaselines, "--nerfbaselines")
        config, run, checkpoint = open_run(self.load_config, self.data)
        if self.nerfbaselines is not None and run.views is None:
            raise DataError(run.data, "it has no test views to predict", "leave out --nerfbaselines")
        from aenerf_ns.evaluation.color_fit import replace_color_correction
        from aenerf_ns.evaluation.evaluate import evaluate

        of_run = run.model.color_correction.protocol
        used = self.color_correction or of_run
        if self.color_correction is not None:
            replace_color_correction(run, used)
        if self.render_output is not None:
            try:
                self.render_output.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise output_error(self.render_output, error, "--render-output") from None
        results = evaluate(run, self.render_output)
        evaluation = {
            "experiment_name": config.experiment_name,
            "method_name": config.method_name,
            "checkpoint": str(checkpoint),
            "protocol": {"color_correction": used, "color_correction_of_run": of_run},
            "results": results,
        }
        with creating(self.output) as file:
            file.write_text(json.dumps(evaluation, indent=2) + "\n", "utf8")
        if results["num_views"] == 0:
            say(f"{self.output}: errors of the poses; there are no views to evaluate on.")
            return
        if self.nerfbaselines is not None:
            from aenerf_ns.export.nerfbaselines import export_predictions

            with creating(self.nerfbaselines, "--nerfbaselines") as folder:
                export_predictions(run, folder, config, results["views"])
        refined = results.get("refined_test_poses")
        metrics = {"placed": results} | ({"refined": refined} if refined else {})
        shown = "; ".join(
            f"PSNR {values['psnr']:.2f} dB, SSIM {values['ssim']:.3f} with test poses {name}"
            for name, values in metrics.items()
        )
        say(f"{self.output}: {shown}; {results['num_views']} views; color correction {results['color_correction']}.")
