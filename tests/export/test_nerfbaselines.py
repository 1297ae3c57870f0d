"""Predictions and results in the layout of nerfbaselines."""

import hashlib
import json
from pathlib import Path

import numpy as np
from PIL import Image

from aenerf_ns.export.nerfbaselines import describe_run, write_predictions, write_results


def test_write_layout_of_nerfbaselines(tmp_path: Path) -> None:
    pictures = [Image.fromarray(np.full((4, 6, 3), value, np.uint8)) for value in (10, 20, 30, 40)]
    info = describe_run("aenerf", "room", 300)
    folder = tmp_path / "predictions"
    write_predictions(folder, [("a", *pictures[:2]), ("a-1", *pictures[2:])], info)
    for kind, name, value in (("color", "a", 10), ("gt-color", "a", 20), ("color", "a-1", 30), ("gt-color", "a-1", 40)):
        assert np.array_equal(Image.open(folder / kind / f"{name}.png"), np.full((4, 6, 3), value))
    written = json.loads((folder / "info.json").read_text())
    assert written.keys() - info.keys() == {"render_version", "render_datetime", "render_dataset_metadata"}
    assert written["evaluation_protocol"] == written["dataset_metadata"]["evaluation_protocol"] == "default"

    views = {"a": {"psnr": 20.1, "ssim": 0.5}, "a-1": {"psnr": 30.25, "ssim": 0.7}}
    write_results(tmp_path / "results.json", folder, info, views)
    results = json.loads((tmp_path / "results.json").read_text())
    # nerfbaselines 1.2.12 computes these values from these metrics.
    assert results["metrics"] == {"psnr": 25.175, "ssim": 0.6}
    assert results["metrics_raw"] == {"psnr": "AADyQc3MoEE=", "ssim": "MzMzPwAAAD8="}
    assert results["metrics_sha256"] == "457960527a1bb69ba7985afbd9d7f1ac934c4d4cfb2c8df20d33ee96a33be702"
    assert results.keys() == {
        "render_datetime", "render_version", "render_dataset_metadata", "nb_info", "evaluate_datetime",
        "evaluate_version", "metrics", "metrics_raw", "metrics_sha256", "predictions_sha256", "ground_truth_sha256",
        "evaluation_protocol",
    }  # fmt: skip
    # In the order of the files, as the raw metrics are.
    files = (folder / "color" / name for name in ("a-1.png", "a.png"))
    expected = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    assert results["predictions_sha256"] == expected != results["ground_truth_sha256"]
