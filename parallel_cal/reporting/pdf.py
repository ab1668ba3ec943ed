"""Print a page to a PDF file with an installed Chromium browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import write_atomically

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
)
MAX_PRINT_TIME_S = 1800.0  # an idle computer prints in 5 s; a busy one may take minutes


class PdfError(ParallelCalError):
    """A PDF cannot be printed."""


def find_browser() -> str:
    """Find the program of a Chromium browser; PdfError if none is installed."""
    for name in BROWSERS:
        if path := shutil.which(name):
            return path
    raise PdfError(
        "no browser that prints PDF: expected one of "
        f"{', '.join(BROWSERS)} on the PATH. Install chromium, or open the page (-o R.html) in any "
        "browser and print it there"
    )


def print_to_pdf(html: str, output: Path, browser: str) -> None:
    """Print the HTML of a page to the PDF file `output`, which is replaced in one step."""
    with tempfile.TemporaryDirectory(prefix="parallel-cal-") as folder:
        page, printed = Path(folder) / "page.html", Path(folder) / "page.pdf"
        page.write_text(html, encoding="utf-8")
        command = [
            browser,
            "--headless",
            "--disable-gpu",
            "--enable-unsafe-swiftshader",
            "--no-pdf-header-footer",
            f"--user-data-dir={folder}/profile",
            "--no-first-run",
            "--disable-extensions",
            "--disable-background-networking",
            f"--print-to-pdf={printed}",
        ]
        if os.geteuid() == 0:  # Chromium refuses its sandbox to root
            command.append("--no-sandbox")
        try:
            ended = subprocess.run(
                [*command, page.as_uri()],
                capture_output=True,
                text=True,
                errors="replace",
                timeout=MAX_PRINT_TIME_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise PdfError(
                f"{output}: {browser} did not print the page within {MAX_PRINT_TIME_S:.0f} s"
            ) from None
        if not printed.exists():
            last = ended.stderr.strip().splitlines()[-1:] or ["no message"]
            raise PdfError(
                f"{output}: {browser} printed no PDF (exit status {ended.returncode}): {last[0]}"
            )
        write_atomically(output, printed.read_bytes())
