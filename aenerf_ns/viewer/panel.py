"""The panel that this project adds to Nerfstudio's viewer, and what it draws in the scene.

Nerfstudio's viewer looks through the pipeline for elements and for controls. It shows the elements of
:class:`RecordingPanel` under "Custom Elements", sorted by the names of the attributes, and sets up the control. Where
no viewer runs, nothing is computed.
"""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import numpy as np
import viser.transforms
from nerfstudio.utils import colormaps
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerControl, ViewerSlider
from numpy.typing import NDArray
from torch import nn
from viser import ClientHandle

from aenerf_ns.errors import errors_as_one_line
from aenerf_ns.evaluation.view_metrics import to_image
from aenerf_ns.viewer.elements import DownloadButton, ViewerMarkdown
from aenerf_ns.viewer.recording_view import RecordingView, png

# Maximum share of the training time that drawing takes, and minimum seconds between two drawings: a browser is sent at
# most 25 KB a second.
_MAX_TIME_SHARE, _MIN_INTERVAL = 0.01, 2.0
_COLORS = {"estimated": (255, 140, 30), "corrected": (60, 220, 90), "true": (255, 255, 255)}
# Steps in which the slider goes through the recording by itself, and the seconds between two of them.
_PLAYED_STEPS, _PLAYED_INTERVAL = 120, 0.5


class RecordingPanel(nn.Module):
    """Shows the recording in the viewer: its events around a time, the trajectories, figures of the run.

    It is a module without parameters, because Nerfstudio looks for elements in modules only.

    Args:
        view: what to show of the run.

    Attributes:
        next_draw_time: the monotonic clock's seconds from which on a training step may draw.
    """

    def __init__(self, view: RecordingView) -> None:
        super().__init__()
        self.view = view
        self._viewer: Viewer | None = None
        self.next_draw_time = 0.0
        # State that the picture and the points were last made for, so that a slider's moves do not queue up.
        self._drawn: tuple[Any, ...] | None = None
        # Not the middle of the recording: a camera of the training cameras, evenly spread, would hide the scene.
        self._first_time = round(0.4 * view.duration, 3)
        # The lines as browsers have them: one that has not changed is not sent again.
        self._lines: dict[str, tuple[bool, bytes]] = {}
        self._playing: threading.Thread | None = None
        self.control = _Control(self)
        self.accuracy = ViewerMarkdown("Accuracy", "")
        self.at_time = ViewerSlider(
            "Time (s)",
            self._first_time,
            0.0,
            view.duration,
            min(max(round(view.duration / 1000, 4), 1e-4), view.duration),
            cb_hook=lambda _: self.show_time(),
            hint="Seconds from the first pose. The frame in the scene is the event camera at this time.",
        )
        self.camera_follows = ViewerCheckbox(
            "Follow",
            False,
            cb_hook=lambda _: self._follow(),
            hint="Look through the event camera, with its field of view. The training cameras are hidden meanwhile.",
        )
        self.camera_plays = ViewerCheckbox(
            "Play", False, cb_hook=lambda _: self._play(), hint="Let the time run through the recording."
        )
        self.events_in_scene = ViewerCheckbox(
            "Events in scene",
            False,
            cb_hook=lambda _: self.show_time(),
            hint="Draw at most 2000 of the events on the surfaces that they come from: red positive, blue negative.",
        )
        self.events_number = ViewerSlider(
            "Events",
            view.usual_number_of_events,
            100,
            20_000,
            100,
            cb_hook=lambda _: self.show_time(),
            hint="Number of events around the time.",
        )
        self.events_picture = ViewerMarkdown("Picture", "")
        self.trajectories = ViewerCheckbox(
            "Trajectories",
            True,
            cb_hook=lambda _: self._show_trajectories(),
            hint="The poses of the event camera, as lines that move while training corrects them.",
        )
        self.trajectories_legend = ViewerMarkdown(
            "Legend", "Lines: orange as given, green corrected, white true (where known)"
        )
        self.write_snapshot = DownloadButton("Export snapshot", self._snapshot)
        self.write_trajectory = DownloadButton("Export trajectory", self._trajectory_file)

    def started(self, viewer: Viewer) -> None:
        """Draw the trajectories, and show every browser the scene from the corrected pose of the slider's time.

        Raises:
            SystemExit: with one clear line, when the events cannot be used.
        """
        with errors_as_one_line():
            self.view.prepare()
        self._viewer = viewer
        viewer.viser_server.on_client_connect(self._welcome)
        self._show_trajectories()
        self._show_figures()

    def after_step(self) -> None:
        """Draw what has changed in training, if a browser looks on and drawing has been rare enough."""
        if self._viewer is None or not self._viewer.render_statemachines:
            return
        began = time.monotonic()
        if began < self.next_draw_time:
            return
        self.draw()
        ended = time.monotonic()
        self.next_draw_time = ended + max(_MIN_INTERVAL, (ended - began) * (1 / _MAX_TIME_SHARE - 1))

    def draw(self) -> None:
        """Draw everything for the run's present state."""
        self._show_trajectories()
        self._show_figures()
        self.show_time(anew=True)

    def show_time(self, anew: bool = False) -> None:
        """Show the slider's time: the event camera, its events, and, if the view follows, what it sees.

        Args:
            anew: draw also what was asked for before. A view that follows then stays, although training moves the pose.
        """
        wanted = (self.at_time.value, self.events_number.value, self.events_in_scene.value, self.camera_follows.value)
        is_new = wanted != self._drawn
        if self._viewer is None or not (is_new or anew):
            return
        self._drawn = wanted
        seconds, count, in_scene, follows = wanted
        pose = self.view.pose(seconds)
        if follows and is_new:
            for client in self._viewer.viser_server.get_clients().values():
                self._place(client, pose)
                client.camera.fov = self.view.vertical_field_of_view
        events = self.view.events(seconds, count)
        if is_new:
            # Training changes no events.
            self.events_picture.show(self.view.described_picture(events, seconds))
        scene = self._viewer.viser_server.scene
        camera = self.view.camera
        wxyz, position = self._in_viewer(pose)
        scene.add_camera_frustum(
            "/recording/event_camera",
            fov=self.view.vertical_field_of_view,
            aspect=camera.width / camera.height * camera.fy / camera.fx,
            scale=3 * self._viewer.config.camera_frustum_scale,
            color=_COLORS["corrected"],
            wxyz=wxyz,
            position=position,
            # A view from within it is hidden by its lines. The first view is.
            visible=not follows and seconds != self._first_time,
        )
        points, colors = self.view.points(events if in_scene else events[:0])
        scene.add_point_cloud(
            "/recording/events",
            points * VISER_NERFSTUDIO_SCALE_RATIO,
            colors,
            point_size=0.002 * VISER_NERFSTUDIO_SCALE_RATIO,
            point_shape="circle",
            visible=in_scene,
        )

    def _in_viewer(self, pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a pose (3, 4), OpenGL axes, as the viewer's quaternion, OpenCV axes, and position."""
        rotation = viser.transforms.SO3.from_matrix(pose[:, :3]) @ viser.transforms.SO3.from_x_radians(np.pi)
        return rotation.wxyz, pose[:, 3] * VISER_NERFSTUDIO_SCALE_RATIO

    def _place(self, client: ClientHandle, pose: NDArray[np.float64]) -> None:
        """Move a browser's view to a pose (3, 4)."""
        with client.atomic():
            client.camera.wxyz, client.camera.position = self._in_viewer(pose)

    def _welcome(self, client: ClientHandle) -> None:
        """Show a browser the scene from a trained pose, and draw for it what has changed while none looked on."""
        self._place(client, self.view.pose(self.at_time.value))
        self.next_draw_time = 0.0
        # In a thread, because a training step may run, and viser holds a lock here that the step's end may wait for.
        threading.Thread(target=self._draw_between_steps, daemon=True).start()
        # It ended if no browser looked on for a moment, as while a page is loaded anew.
        self._play()

    def _draw_between_steps(self) -> None:
        """Draw when no training step runs, and hold the next one back meanwhile."""
        assert self._viewer is not None
        with self._viewer.train_lock or contextlib.nullcontext():
            self.draw()

    def _show_trajectories(self) -> None:
        if self._viewer is None:
            return
        visible = self.trajectories.value
        for name, points in self.view.lines().items():
            state = (visible, points.tobytes())
            if self._lines.get(name) == state:
                continue
            self._lines[name] = state
            self._viewer.viser_server.scene.add_spline_catmull_rom(
                f"/recording/trajectory_{name}",
                points * VISER_NERFSTUDIO_SCALE_RATIO,
                line_width=2.0,
                color=_COLORS[name],
                segments=2 * len(points),
                visible=visible,
            )

    def _show_figures(self) -> None:
        if self._viewer is not None:
            # Nerfstudio's own line of the step stands still where rendering takes long.
            self.accuracy.show(f"**Step** {self._viewer.step:,}\n\n{self.view.figures()}")

    def _follow(self) -> None:
        """Begin or end to look through the event camera."""
        if self._viewer is None:
            return
        if hasattr(self._viewer, "camera_handles") and self._viewer.hide_images.visible:
            # They stand between the view and the scene. The user's own choice to hide them stays.
            self._viewer.set_camera_visibility(not self.camera_follows.value)
        self.show_time()

    def _play(self) -> None:
        """Let the time run on in a thread, as long as the box is ticked and a browser looks on."""
        if self.camera_plays.value and (self._playing is None or not self._playing.is_alive()):
            self._playing = threading.Thread(target=self._run_on, daemon=True)
            self._playing.start()

    def _run_on(self) -> None:
        while self.camera_plays.value and self._viewer is not None and self._viewer.render_statemachines:
            later = self.at_time.value + self.view.duration / _PLAYED_STEPS
            # The element's hook, called by this, draws.
            self.at_time.value = later if later <= self.view.duration else 0.0
            time.sleep(_PLAYED_INTERVAL)

    def _snapshot(self, client: ClientHandle) -> tuple[str, bytes]:
        """Render a browser's view at the highest resolution that the viewer is set to, as a PNG file."""
        assert self._viewer is not None
        panel = self._viewer.control_panel
        aspect = client.camera.aspect
        height = panel.max_res / max(aspect, 1.0)
        camera = self.control.get_camera(round(height), round(height * aspect), client.client_id)
        model = self._viewer.get_model()
        was_training = model.training
        model.eval()
        outputs = model.get_outputs_for_camera(camera.to(model.device))
        model.train(was_training)
        name = panel.output_render if panel.output_render in outputs else "rgb"
        shown = colormaps.apply_colormap(outputs[name], panel.colormap_options)
        return f"snapshot_{name}_{self._viewer.step:06}.png", png(np.asarray(to_image(shown)))

    def _trajectory_file(self, _: ClientHandle) -> tuple[str, bytes]:
        assert self._viewer is not None
        return f"trajectory_{self._viewer.step:06}.txt", self.view.trajectory_file()


class _Control(ViewerControl):
    """Tells the panel that a viewer has started."""

    def __init__(self, panel: RecordingPanel) -> None:
        self._panel = panel

    def _setup(self, viewer: Viewer) -> None:
        """Keep the viewer, as Nerfstudio does, and tell the panel."""
        super()._setup(viewer)
        self._panel.started(viewer)
