"""Drop zone for images: buttons in place, and the whole page while a file is dragged over it."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from nicegui import ui

from sightline.app.web.transfers import MAX_UPLOAD_BYTES, OnUpload, Upload, Uploads
from sightline.imaging.formats import SUFFIXES


class DropZone(ui.element, component=Path(__file__).parent / "drop.js"):
    """Accepts images for named targets; each goes to its target's `on_upload`, run in this element's slot."""

    def __init__(
        self, uploads: Uploads, targets: dict[str, OnUpload], boxes: Mapping[str, ui.element] = MappingProxyType({})
    ) -> None:
        """`boxes`: by target the part of the page that takes its files; while nothing is in it, it says so."""
        self._uploads = uploads
        self._addresses = {label: uploads.open(self._here(on_upload)) for label, on_upload in targets.items()}
        super().__init__()
        self._props["targets"] = [{"label": label, "address": where} for label, where in self._addresses.items()]
        for target in self._props["targets"]:
            box = boxes.get(target["label"])
            target["box"] = None if box is None else f"c{box.id}"
        self._props["maxBytes"] = MAX_UPLOAD_BYTES
        self._props["accept"] = ",".join([*SUFFIXES, "application/dicom"])

    def tell(self, states: Mapping[str, str], names: Mapping[str, str], labels: Mapping[str, str]) -> None:
        """Say what each target shows: "empty", "here", or "failed"; targets that are not named take nothing now.
        `names`: of their images, as in a sentence; `labels`: of their buttons, where not the target's own."""
        self.run_method("tell", dict(states), dict(names), dict(labels))

    def _here(self, on_upload: OnUpload) -> OnUpload:
        async def run(upload: Upload) -> None:
            with self:  # so that elements it adds, such as a notification, go to this page
                pending = on_upload(upload)
                if pending is not None:
                    await pending

        return run

    def _handle_delete(self) -> None:
        for address in self._addresses.values():
            self._uploads.close(address)
        super()._handle_delete()
