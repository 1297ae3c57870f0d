"""The viewer's panel as a user sees it: through Chromium, which draws it."""

from pathlib import Path

import pytest
from helpers.browser import chromium, eventually
from helpers.small_pipelines import make_pipeline
from helpers.small_viewers import DURATION, NUM_EVENTS, make_recording, viewer_of

from aenerf_ns.files.tum_trajectory import read_tum_trajectory

PICTURE = "document.querySelector('img[alt=events]')?.src"


def control(label: str) -> str:
    """The JavaScript expression of the control that has a label."""
    labels = f"[...document.querySelectorAll('label')].find((one) => one.textContent.trim() === {label!r})"
    return f"document.getElementById({labels}?.htmlFor)"


def button(text: str) -> str:
    """The JavaScript expression of the button that has a text."""
    return f"[...document.querySelectorAll('button')].find((one) => one.textContent.trim() === {text!r})"


def test_panel_in_chromium(tmp_path: Path) -> None:
    pipeline = make_pipeline(make_recording(tmp_path / "data"), "val", pose_correction="spline")
    panel = pipeline.recording
    downloads = tmp_path / "downloads"
    with viewer_of(pipeline, tmp_path) as viewer, chromium(tmp_path) as page:
        # Pictures of few pixels, because the browser's graphics and the rendering share the processor.
        viewer.control_panel._max_res.value = 64
        page.save_downloads_in(downloads)
        page.open(f"http://127.0.0.1:{viewer.viser_server.get_port()}", 700, 600)

        def click(element: str) -> None:
            # The page is built anew whenever a text changes.
            page.wait_for(f"{element} && ({element}.click(), true)")

        page.wait_for("document.querySelector('table')?.textContent.includes('rotation (°)')")
        before = page.wait_for(PICTURE)
        assert before.startswith("data:image/png;base64,")
        slider = f"{control('Time (s)')}?.querySelector('[role=slider]')"
        assert float(page.wait_for(f"{slider}?.getAttribute('aria-valuenow')")) == 0.8
        page.evaluate(f"{slider}.focus()")
        page.press("End")
        eventually(lambda: panel.at_time.value == DURATION)
        eventually(lambda: page.evaluate(PICTURE) not in (None, before))
        click(control("Events in scene"))
        eventually(lambda: panel.events_in_scene.value)
        click(control("Follow"))
        (client,) = viewer.viser_server.get_clients().values()
        position = 10 * panel.view.pose(DURATION)[:, 3]
        # What the browser says of its own view.
        eventually(lambda: client.camera.position == pytest.approx(position, abs=1e-3))
        assert client.camera.fov == pytest.approx(panel.view.vertical_field_of_view)
        click(button("Export trajectory"))
        click(button("Export snapshot"))
        eventually(lambda: (downloads / "snapshot_rgb_000000.png").exists())
        eventually(lambda: (downloads / "trajectory_000000.txt").exists())
        assert len(read_tum_trajectory(downloads / "trajectory_000000.txt")) == 9
        assert len(pipeline.datamanager.train_dataset.timeline) <= NUM_EVENTS
