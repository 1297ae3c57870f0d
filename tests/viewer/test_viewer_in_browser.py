"""The viewer's panel as a user sees it: through Chromium, which draws it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from small_viewers import DURATION, NUM_EVENTS, make_pipeline_of, make_recording, viewer_of

from aenerf_ns.files.tum_trajectory import read_tum_trajectory

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--window-size=700,600",
    # The page asks for a logo and for statistics elsewhere.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip


@pytest.fixture
def chromium(tmp_path: Path) -> Iterator[Any]:
    """A browser that saves what it downloads in the folder ``downloads``."""
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("Chromium or its driver is not installed (Debian: chromium, chromium-driver)")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(flag)
    (tmp_path / "downloads").mkdir()
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    try:
        where = {"behavior": "allow", "downloadPath": str(tmp_path / "downloads")}
        browser.execute_cdp_cmd("Browser.setDownloadBehavior", where)
        yield browser
    finally:
        browser.quit()


def test_the_panel_in_chromium(chromium: Any, tmp_path: Path) -> None:
    pipeline = make_pipeline_of(make_recording(tmp_path / "data"))
    panel = pipeline.recording
    with viewer_of(pipeline, tmp_path) as viewer:
        # Pictures of few pixels, because the browser's graphics and the rendering share the processor.
        viewer.control_panel._max_res.value = 64
        chromium.get(f"http://127.0.0.1:{viewer.viser_server.get_port()}")

        def element(kind: str, text: str) -> Any:
            return chromium.find_element("xpath", f"//{kind}[normalize-space()='{text}']")

        def control(label: str) -> Any:
            return chromium.find_element("id", element("label", label).get_attribute("for"))

        def picture() -> str:
            return chromium.find_element("xpath", "//img[@alt='events']").get_attribute("src")

        def click(find: Callable[[], Any]) -> None:
            # The page is built anew whenever a text changes.
            eventually(lambda: (chromium.execute_script("arguments[0].click()", find()), True)[1])

        eventually(lambda: "rotation (°)" in chromium.find_element("tag name", "table").text)
        before = eventually(picture)
        assert before.startswith("data:image/png;base64,")
        slider = control("Time (s)").find_element("css selector", "[role=slider]")
        assert float(slider.get_attribute("aria-valuenow")) == 0.8
        slider.send_keys("\ue010")  # the key End
        eventually(lambda: panel.at_time.value == DURATION)
        eventually(lambda: picture() != before)
        click(lambda: control("Events in scene"))
        eventually(lambda: panel.events_in_scene.value)
        click(lambda: control("Follow"))
        (client,) = viewer.viser_server.get_clients().values()
        _, position = panel._in_viewer(panel._view.pose(DURATION))
        # What the browser says of its own view.
        eventually(lambda: client.camera.position == pytest.approx(position, abs=1e-3))
        assert client.camera.fov == pytest.approx(panel._view.vertical_field_of_view)
        click(lambda: element("button", "Export trajectory"))
        click(lambda: element("button", "Export snapshot"))
        downloads = tmp_path / "downloads"
        eventually(lambda: (downloads / "snapshot_rgb_000000.png").exists())
        eventually(lambda: (downloads / "trajectory_000000.txt").exists())
        assert len(read_tum_trajectory(downloads / "trajectory_000000.txt")) == 9
        assert len(pipeline.datamanager.train_dataset.timeline) <= NUM_EVENTS


def eventually(condition: Callable[[], Any]) -> Any:
    """Wait for a condition, and return what it gives. While the page is built, elements come and go."""
    from selenium.common.exceptions import WebDriverException

    deadline = time.monotonic() + 60
    while True:
        try:
            found = condition()
            if found:
                return found
        except WebDriverException:
            if time.monotonic() > deadline:
                raise
        assert time.monotonic() < deadline
        time.sleep(0.1)
