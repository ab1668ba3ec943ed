"""Discover laws in a session: the effect files of proven laws lie in the session's folder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from parallel_cal.base.progress import Progress
from parallel_cal.discovery.discovery import discover
from parallel_cal.discovery.effect_file import write_effect_file
from parallel_cal.discovery.law import Discovery, Law
from parallel_cal.session.session import Session

DIGEST_LENGTH = 6  # hex digits in the name of a law: names of different laws differ


def discover_in_session(
    session: Session, progress: Progress | None = None
) -> tuple[Discovery, list[Path]]:
    """Search for laws in what a session's model leaves, and write each proven law to an effect
    file, by whose name `session.add` takes it. The session's state is unchanged."""
    data = session.dataset
    found = discover(session.model, data, options=session.options_for(data), progress=progress)
    return found, write_laws(found.laws, session.effects_folder)


def write_laws(laws: Sequence[Law], folder: Path) -> list[Path]:
    """Write each law as an effect file to a folder; the name follows from place and text."""
    return write_effects(list_effects(laws), folder)


def list_effects(laws: Sequence[Law]) -> dict[str, str]:
    """The text of each law's effect file, by the name of the effect."""
    return {name_effect(law): law.text for law in laws}


def write_effects(texts: Mapping[str, str], folder: Path) -> list[Path]:
    """Write effect files to a folder: the text of each, by the name of the effect."""
    files = {folder / f"{name}.py": text for name, text in texts.items()}
    if files:
        folder.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        write_effect_file(file, text)
    return list(files)


def name_effect(law: Law) -> str:
    """A name for the effect of a law: `law_joint2_1f09ab`."""
    place = re.sub(r"\W+", "_", law.place.partition(",")[0])
    return f"law_{place}_{hashlib.sha256(law.text.encode()).hexdigest()[:DIGEST_LENGTH]}"
