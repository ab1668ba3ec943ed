"""Where an export writes its files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from parallel_cal.base.errors import ModelError
from parallel_cal.base.files import BACKUP_SUFFIX, write_atomically
from parallel_cal.exporting.editing import read_verbatim


def place_files(target: str, made: Mapping[str, str], output: Path) -> dict[Path, str]:
    """Say where each of the files that a target `made` is written.

    Parameters
    ----------
    target : str
        The name of the target.
    made : Mapping
        The texts of the files by their names.
    output : Path
        The folder; or, of a single file, its name, if it has the ending of the file.

    Returns
    -------
    dict
        The texts by their paths.

    Raises
    ------
    ModelError
        If `output` is the name of a file and the target writes several, or one of another kind.
    """
    endings = {Path(file).suffix for file in made} - {""}
    names_file = output.suffix in endings and not output.is_dir()
    if not (names_file or output.is_file()):
        return {output / file: text for file, text in made.items()}
    if names_file and len(made) == 1:
        return dict(zip([output], made.values(), strict=True))
    written = ", ".join(sorted(made))
    expected = "a folder"
    if len(made) == 1:
        expected += f", or a file whose name ends in {endings.pop()}"
    raise ModelError(f"{output} is the name of a file: {target} writes {written}: give {expected}")


def replace_files(texts: Mapping[Path, str]) -> None:
    """Write files that change, and keep the old ones as `NAME.previous`."""
    for path, text in texts.items():
        if (old := read_verbatim(path)) != text:
            write_atomically(path.with_name(path.name + BACKUP_SUFFIX), old, like=path)
            write_atomically(path, text)
