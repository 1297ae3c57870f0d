"""Elements of Nerfstudio's viewer that Nerfstudio lacks."""

from __future__ import annotations

from collections.abc import Callable

from nerfstudio.viewer.viewer_elements import ViewerElement
from viser import ClientHandle, ViserServer


class ViewerMarkdown(ViewerElement[str]):
    """A text in Markdown, which may hold tables and pictures. The element's name is not shown."""

    def __init__(self, name: str, content: str) -> None:
        super().__init__(name)
        self.content = content

    def install(self, viser_server: ViserServer) -> None:
        """Add the element to the viewer."""
        self.gui_handle = viser_server.gui.add_markdown(self.content)

    def show(self, content: str) -> None:
        """Replace the text. Browsers are sent a new one if it differs."""
        if content != self.content:
            self.content = self.gui_handle.content = content


class DownloadButton(ViewerElement[bool]):
    """A button that sends a file to the browser in which it was clicked. ``make`` gives the file's name and content."""

    def __init__(self, name: str, make: Callable[[ClientHandle], tuple[str, bytes]]) -> None:
        super().__init__(name, cb_hook=lambda client: client.send_file_download(*make(client)))

    def install(self, viser_server: ViserServer) -> None:
        """Add the element to the viewer."""
        button = self.gui_handle = viser_server.gui.add_button(self.name)
        # Nerfstudio wraps the hook so that it waits until no training step runs, and passes its argument on.
        button.on_click(lambda event: self.cb_hook(event.client))
