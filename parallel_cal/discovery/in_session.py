"""Discover laws in a session: the effect files of proven laws lie in the session's folder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from parallel_cal.base.progress import Progress
from parallel_cal.discovery.discovery import Discovery, Law, discover
from parallel_cal.discovery.effect_file import write_effect_file
from parallel_cal.session.session import Session

DIGEST_LENGTH = 6  # hex digits in the name of a law: names of different laws differ


def discover_in_session(
    session: Session, progress: Progress | None = None
) -> tuple[Discovery, list[Path]]:
    """Search for laws in what a session's model leaves, and write each proven law to an effect
    file, by whose name `session.add` takes it. The session's state is unchanged."""
    found = discover(session.model, session.dataset, options=session.options, progress=progress)
    return found, write_laws(found.laws, session.effects_folder)


def write_laws(laws: Sequence[Law], folder: Path) -> list[Path]:
    """Write each law as an effect file to a folder; the name follows from place and text."""
    files = [folder / f"{name_effect(law)}.py" for law in laws]
    if files:
        folder.mkdir(parents=True, exist_ok=True)
    for law, file in zip(laws, files, strict=True):
        write_effect_file(file, law.text)
    return files


def name_effect(law: Law) -> str:
    """A name for the effect of a law: `law_joint2_1f09ab`."""
    place = re.sub(r"\W+", "_", law.place.partition(",")[0])
    return f"law_{place}_{hashlib.sha256(law.text.encode()).hexdigest()[:DIGEST_LENGTH]}"
