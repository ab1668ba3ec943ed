"""The dialog that imports a table, and draws its poses on the robot."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nicegui import events, run, ui

from parallel_cal.workbench.bench import Bench
from parallel_cal.workbench.column_form import ColumnForm
from parallel_cal.workbench.widgets import draw_figure

SUFFIXES = ".csv,.tsv,.txt,.json"
POLL_INTERVAL_S = 0.1
# The buttons that Quasar draws in their place have no names for screen readers.
UPLOAD_HEADER = """
<div class="row no-wrap items-center q-pa-sm">
  <label class="col relative-position q-uploader__title">
    Drop a file here (.csv, .tsv, .txt, .json)
    <q-uploader-add-trigger v-if="props.canAddFiles" />
  </label>
  <q-btn v-if="props.canAddFiles" dense flat label="Choose a file" @click="props.pickFiles" />
</div>
"""
UPLOAD_LIST = """
<div v-for="file in props.files" :key="file.__key">{{ file.name }}, {{ file.__sizeLabel }}</div>
"""


class ImportDialog:
    """A dialog in two steps: drop a table, then name its columns."""

    def __init__(self, bench: Bench):
        self._bench = bench
        self._folder = tempfile.TemporaryDirectory(prefix="parallel-cal-")
        self._file: Path | None = None
        self._columns: ColumnForm | None = None  # of a table
        self._asked = ""  # what is missing of the columns, once a person pressed Import
        self._awaits_result = False
        self._drawn: dict[str, Any] = {}  # the column map whose poses are drawn
        # A click beside a dialog that is persistent loses nothing.
        dialog = ui.dialog(value=True).props('persistent aria-label="Import a table"')
        with dialog as self._dialog, ui.card().classes("w-full max-w-5xl gap-2"):
            ui.label("Import a table").classes("text-base font-bold").props(
                "role=heading aria-level=2"
            )
            ui.label(
                "A table has a header and one row per measured pose. Samples that parallel-cal "
                "import made of a controller's files (.json), such as touches of a printer's bed, "
                "need no columns. They are added to those of the session; Undo reverses that."
            ).classes("text-sm")
            upload = ui.upload(auto_upload=True, max_files=1, on_upload=self._receive)
            upload.props(f'flat bordered accept="{SUFFIXES}"').classes("w-full")
            upload.add_slot("header", UPLOAD_HEADER)
            upload.add_slot("list", UPLOAD_LIST)
            self._form = ui.column().classes("w-full gap-2")
            self._answer = ui.label().props("id=import-answer role=alert").classes("text-sm")
            with ui.row():
                self._import = ui.button("Import", on_click=self._begin).props("dense")
                self._import.set_enabled(False)
                ui.button("Close", on_click=self._dialog.close).props("dense outline")
            # Below the buttons, which must not move away from under a click.
            self._counts = ui.label().props("id=import-counts role=status").classes("text-sm")
            self._poses = ui.element().classes("w-full")
            # Drawing takes seconds, during which the page still follows an import.
            timers = [ui.timer(POLL_INTERVAL_S, act) for act in (self._follow, self._draw_poses)]
        self._dialog.on_value_change(lambda: self._end(timers))

    def _end(self, timers: Sequence[ui.timer]) -> None:
        for timer in timers:
            timer.cancel()
        self._folder.cleanup()

    async def _receive(self, event: events.UploadEventArguments) -> None:
        """Show the form for a table that was dropped."""
        from parallel_cal.session.table_preview import preview_file  # imports NumPy

        file = Path(self._folder.name) / Path(event.file.name).name
        await event.file.save(file)
        self._answer.set_text("")
        self._counts.set_text(f"reading {file.name}")
        found = await run.cpu_bound(preview_file, file, self._bench.session.folder) or {}
        self._poses.clear()
        self._counts.set_text(found.get("words", ""))
        self._drawn, self._columns = {}, None
        problem = found.get("error", "the table cannot be read")
        self._answer.set_text(problem.replace(str(file), file.name))  # it lies in another folder
        self._file, self._asked = (None if self._answer.text else file), ""
        self._show_form(found)

    def _show_form(self, found: Mapping[str, Any]) -> None:
        """Show the form of a table; say from which earlier table its entries are, if any."""
        self._form.clear()
        if self._file is None or "words" in found:
            return
        with self._form:
            if found["remembered"] is not None:
                with ui.row().classes("items-center gap-x-3 gap-y-0"):
                    words = f"Columns, units and noise as in {found['remembered_from']}."
                    ui.label(words).classes("text-sm").props("id=remembered")
                    afresh = {**found, "remembered": None}
                    ui.button(
                        "Read the header instead", on_click=lambda: self._show_form(afresh)
                    ).props("dense flat no-caps")
            self._columns = ColumnForm(found)

    def _begin(self) -> None:
        if self._file is None:
            return
        if problem := self._columns.find_problem() if self._columns else "":
            self._asked = problem
            self._answer.set_text(problem)
            return
        self._answer.set_text("")
        self._awaits_result = True
        columns = self._columns.document() if self._columns else {}
        self._bench.begin("import_table", self._file, columns)

    async def _draw_poses(self) -> None:
        """Draw the poses on the robot whenever all needed columns are chosen anew."""
        if self._file is None or self._columns is None or self._columns.find_problem():
            return
        if (document := self._columns.document()) == self._drawn:
            return
        from parallel_cal.workbench.import_preview import preview_samples  # imports NumPy

        self._drawn = document
        found = await run.cpu_bound(
            preview_samples, self._file, self._bench.session.folder, document
        )
        if found is None or document != self._drawn:
            return
        self._counts.set_text(found["error"] or found["words"])
        self._poses.clear()
        if figure := found.get("figure"):
            with self._poses:
                draw_figure(figure, "poses of the table on the robot")

    def _follow(self) -> None:
        """Show what became of the import; close after a success."""
        bench = self._bench
        self._import.set_enabled(self._file is not None and not bench.busy)
        if self._asked and self._columns:  # what a person then chooses may solve it
            self._asked = self._columns.find_problem()
            self._answer.set_text(self._asked)
        if not self._awaits_result or bench.busy:
            return
        self._awaits_result = False
        if bench.failed:
            self._answer.set_text(bench.message)
        else:
            self._dialog.close()
