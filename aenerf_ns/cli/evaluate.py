"""``aenerf evaluate``: the metrics of ``ns-eval``, under the run's colour correction or another one."""

from __future__ import annotations

import json
from dataclasses import dataclass

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.arguments import EvaluateArguments
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.files.output_paths import created


@dataclass
class Evaluate(EvaluateArguments):
    __doc__ = EvaluateArguments.__doc__

    def main(self) -> None:
        """Load the run, evaluate it and write the metrics."""
        self.judge()
        # Imported lazily, because these imports take seconds.
        from aenerf_ns.evaluation.color_fit import replace_color_correction
        from aenerf_ns.evaluation.evaluate import evaluate

        config, run, checkpoint = open_run(self.load_config)
        of_run = run.model.color_correction.protocol
        used = self.color_correction or of_run
        if self.color_correction is not None:
            replace_color_correction(run, used)
        if self.render_output is not None:
            with created(self.render_output, "--render-output"):
                self.render_output.mkdir(exist_ok=True)
        results = evaluate(run, self.render_output)
        evaluation = {
            "experiment_name": config.experiment_name,
            "method_name": config.method_name,
            "checkpoint": str(checkpoint),
            "protocol": {
                "color_correction": used,
                "color_correction_of_run": of_run,
            },
            "results": results,
        }
        with created(self.output, "--output"):
            self.output.write_text(json.dumps(evaluation, indent=2) + "\n", "utf8")
        if results["num_views"] == 0:
            CONSOLE.print(f"{self.output}: errors of the poses; there are no views to evaluate on.")
            return
        if self.nerfbaselines is not None:
            # Imported lazily, because few evaluations need it.
            from aenerf_ns.export.predictions import export_predictions

            with created(self.nerfbaselines, "--nerfbaselines"):
                export_predictions(run, self.nerfbaselines, config, results["views"])
        refined = results.get("refined_test_poses")
        figures = {"placed": results} | ({"refined": refined} if refined else {})
        shown = "; ".join(
            f"PSNR {one['psnr']:.2f} dB, SSIM {one['ssim']:.3f} with test poses {name}" for name, one in figures.items()
        )
        CONSOLE.print(
            f"{self.output}: {shown}; {results['num_views']} views; colour correction {results['color_correction']}.",
            soft_wrap=True,
        )
