"""The seam: a sampler and a supervision belong together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.small_pipelines import make_pipeline_config

from aenerf_ns.supervision.base import SamplerConfig
from aenerf_ns.supervision.peers.frames import FrameSampler


def test_a_sampler_for_another_supervision_is_refused(tmp_path: Path) -> None:
    config = make_pipeline_config(tmp_path / "data")
    config.datamanager = replace(config.datamanager, sampler=SamplerConfig(_target=FrameSampler))
    message = "its sampler draws a FrameBatch, and its supervision compares a PairBatch; give it"
    with pytest.raises(SystemExit, match=message):
        config.setup(device="cpu", test_mode="val")
