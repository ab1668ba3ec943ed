"""The dialog with the fields of the certificate, which the report of a session takes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path

from nicegui import ui

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import write_atomically
from parallel_cal.reporting.certificate import LIMITS, CertificateFields

ABOUT = "An empty field stays blank for a pen. The next report of this session has these fields."


class CertificateDialog:
    """The fields of a certificate in a `file`; Save writes them."""

    def __init__(self, file: Path) -> None:
        self._file = file
        try:
            stated, problem = CertificateFields.read(file if file.exists() else None), ""
        except ParallelCalError as error:  # of a file that a person wrote
            stated, problem = CertificateFields(), str(error)
        dialog = ui.dialog(value=True).props("persistent aria-label=Certificate")
        with dialog as self._dialog, ui.card():
            ui.label("Certificate").classes("text-base font-bold").props(
                "role=heading aria-level=2"
            )
            ui.label(ABOUT).classes("text-sm")
            with ui.row().classes("gap-x-4 gap-y-0"):
                self._entries = {
                    one.name: ui.input(_name(one.name, one.metadata)).classes("w-64")
                    for one in fields(CertificateFields)
                }
            for name, value in asdict(stated).items():
                self._entries[name].value = "" if value is None else str(value)
            self._problem = ui.label(problem).props("id=certificate-problem role=alert")
            with ui.row():
                ui.button("Save fields", on_click=self._save).props("dense")
                ui.button("Close", on_click=self._dialog.close).props("dense outline")

    def _save(self) -> None:
        entered = {name: (one.value or "").strip() for name, one in self._entries.items()}
        filled = {name: value for name, value in entered.items() if value}
        try:
            CertificateFields.read(None, [f"{name}={value}" for name, value in filled.items()])
        except ParallelCalError as error:
            self._problem.set_text(str(error).removeprefix("--field "))
            return
        write_atomically(self._file, json.dumps(filled, indent=1) + "\n")  # JSON is YAML
        self._dialog.close()


def _name(field: str, metadata: Mapping[str, str]) -> str:
    """Name a field for people: its words, or the limit of an error with its unit."""
    if field in LIMITS:
        unit = field.removeprefix("limit_").replace("um", "µm")
        return f"Limit of {LIMITS[field]} [{unit}]"
    return metadata["words"]
