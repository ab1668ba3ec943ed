"""The pages of the documentation site that are made at its build.

They are pages of the repository that lie outside docs/, and pages that are read from the code: the
help of the commands, the schema of the model file, the ROS interfaces and the public Python names.
They are written to docs/made/, which git ignores.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

FOLDER = "made"
# A file of the repository and its page on the site.
REPOSITORY_PAGES = {
    "README.md": f"{FOLDER}/readme",
    "CHANGELOG.rst": f"{FOLDER}/changelog",
    "CODE_OF_CONDUCT.md": f"{FOLDER}/code_of_conduct",
    "CONTRIBUTING.md": f"{FOLDER}/contributing",
    "CONVENTIONS.md": f"{FOLDER}/conventions",
    "QUALITY_DECLARATION.md": f"{FOLDER}/quality_declaration",
    "SECURITY.md": f"{FOLDER}/security_policy",
    "bags/README.md": f"{FOLDER}/bags",
    "examples/README.md": f"{FOLDER}/examples",
    "findings/README.md": f"{FOLDER}/findings",
    "real/README.md": f"{FOLDER}/real",
}
# A folder of the repository and the page that describes its content.
FOLDER_PAGES = {"docs": "index.rst", "msg_defs": f"{FOLDER}/ros_interfaces.md"}
# A picture in two colour schemes, which only HTML can state. The site shows the light one.
PICTURE = re.compile(r'<picture>.*?<img src="(.*?)" alt="(.*?)">\s*</picture>', re.S)
LINK = re.compile(r"(\]\()([^)#:\s]+)((?:#[^)]*)?\))")


def find_repository(start: Path) -> Path:
    """Find the repository: the nearest folder above `start` that holds package.xml and the code.

    Where rosdoc2 builds outside the repository, the imported package leads to it.
    """
    for folder in (*start.resolve().parents, *_find_imported_package()):
        # rosdoc2 puts copies of package.xml, but not the code, into folders of its own.
        if (folder / "package.xml").exists() and (folder / "parallel_cal/__init__.py").exists():
            return folder
    raise SystemExit(
        f"{start}: neither a folder above it nor the folder of the imported parallel_cal holds our "
        "package.xml. Put the repository on PYTHONPATH"
    )


def _find_imported_package() -> list[Path]:
    try:
        import parallel_cal
    except ImportError:
        return []
    return [Path(parallel_cal.__file__).resolve().parents[1]]


def write_pages(folder: Path, root: Path) -> None:
    """Write all pages; leave a page alone that is as it should be, so Sphinx need not read it."""
    pages = {
        f"{FOLDER}/command_line.md": command_line(),
        f"{FOLDER}/model_file_schema.md": model_file_schema(),
        f"{FOLDER}/ros_interfaces.md": ros_interfaces(root),
        f"{FOLDER}/python_names.rst": python_names(root),
    }
    for name, page in REPOSITORY_PAGES.items():
        text = PICTURE.sub(r"![\2](\1)", (root / name).read_text(encoding="utf-8"))
        if name == "examples/README.md":
            text += "".join(_scripts(root / "examples"))
        pages[page + Path(name).suffix] = text
    for page, text in pages.items():
        file = folder / page
        file.parent.mkdir(exist_ok=True)
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


def adapt_links(text: str, page: str, root: Path) -> str:
    """Adapt the links of a page to where the site has their targets.

    A page keeps the links that are right in the repository. The pages of its root have another
    place on the site, and a folder has a page that describes its content.
    """
    source = next((name for name, made in REPOSITORY_PAGES.items() if made == page), None)
    origin = (root / source).parent if source else (root / "docs" / page).parent
    if page.startswith(f"{FOLDER}/") and source is None:
        return text
    here = Path(page).parent

    def adapted(found: re.Match[str]) -> str:
        opening, target, rest = found.groups()
        path = Path(os.path.normpath(origin / target)).relative_to(root)
        if source == "examples/README.md" and path.suffix == ".py":
            return f"{opening}#{path.name.replace('.', '')})"
        if str(path) in REPOSITORY_PAGES:
            there = REPOSITORY_PAGES[str(path)] + path.suffix
        elif str(path) in FOLDER_PAGES:
            there = FOLDER_PAGES[str(path)]
        else:
            there = os.path.relpath(path, "docs")
        return f"{opening}{os.path.relpath(there, here)}{rest}"

    return LINK.sub(adapted, text)


def _scripts(folder: Path) -> Iterator[str]:
    for script in sorted(folder.glob("*.py")):
        yield f"\n## {script.name}\n\n```python\n{script.read_text(encoding='utf-8')}```\n"


def command_line() -> str:
    """The help of every command, as the command prints it."""
    import typer

    from parallel_cal.cli.main import OTHER_NAMES, application

    parts = [
        "# The command line",
        "The help of every command, as `parallel-cal COMMAND --help` prints it.",
    ]
    group: Any = typer.main.get_command(application([]))
    for name, command in group.commands.items():
        if name in OTHER_NAMES:
            continue
        parts.append(f"## {name}")
        parts.append(_help(command, f"parallel-cal {name}"))
        for child_name, child in getattr(command, "commands", {}).items():
            parts.append(f"### {name} {child_name}")
            parts.append(_help(child, f"parallel-cal {name} {child_name}"))
    return "\n\n".join(parts) + "\n"


def _help(command: Any, name: str) -> str:
    """What a command prints for --help, 80 columns wide."""
    printed = StringIO()
    with redirect_stdout(printed):
        command.main(
            ["--help"],
            prog_name=name,
            standalone_mode=False,
            max_content_width=80,
            terminal_width=80,
        )
    return f"```text\n{printed.getvalue().strip()}\n```"


def model_file_schema() -> str:
    """Tables of the keys of a model file, from the pydantic model that reads it."""
    from parallel_cal.model.file.schema import FilePart

    schema = FilePart.model_json_schema(by_alias=True)
    parts = [
        "# The keys of a model file",
        "A model file is YAML. Numbers are SI: m, rad, s, kg. An unknown key is an error. These "
        "tables are made from the code that reads the file (`parallel_cal/model/file/schema.py`).",
    ]
    for name, part in {"FilePart": schema, **schema["$defs"]}.items():
        if "properties" not in part:
            continue
        rows = [
            f"| `{key}` | {_kind(value)} | {_default(key, value, part)} |"
            for key, value in part["properties"].items()
        ]
        text = part.get("description", "").replace("{", "\\{")
        title = "The file" if name == "FilePart" else name.removesuffix("Part")
        parts.append(f"## {title}\n\n{text}\n\n| key | value | default |\n|---|---|---|")
        parts[-1] += "\n" + "\n".join(rows)
    return "\n\n".join(parts) + "\n"


def _kind(value: dict[str, Any]) -> str:
    """A type of JSON schema in words, with a link to the table of a part."""
    if "$ref" in value:
        name = value["$ref"].rsplit("/", 1)[1]
        title = name.removesuffix("Part")
        return f"[{title}](#{title.lower()})" if name != title else "any value"
    for key in ("anyOf", "oneOf", "allOf"):
        if key in value:
            return " or ".join(dict.fromkeys(_kind(v) for v in value[key]))
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return ", ".join(f"`{v}`" for v in value["enum"])
    kind = value.get("type")
    if kind == "array":
        count = f"{value['minItems']} " if "minItems" in value else ""
        return f"list of {count}{_kind(value.get('items', {}))}"
    if kind == "object":
        inner = value.get("additionalProperties")
        return f"mapping of names to {_kind(inner)}" if isinstance(inner, dict) else "mapping"
    if kind in ("number", "integer"):
        limits = {"exclusiveMinimum": "above", "minimum": "of at least"}
        words = [f"{word} {value[key]:g}" for key, word in limits.items() if key in value]
        return " ".join([str(kind), *words])
    return {"string": "text", "boolean": "`true` or `false`", "null": "`null`"}.get(
        str(kind), "any value"
    )


def _default(key: str, value: dict[str, Any], part: dict[str, Any]) -> str:
    if key in part.get("required", ()):
        return "required"
    default = value.get("default")
    if default is None:
        return "`null`"
    if isinstance(default, dict) and len(default) > 2:
        return "the defaults of its table"
    return f"`{str(default).lower() if isinstance(default, bool) else default}`"


def ros_interfaces(root: Path) -> str:
    """The messages, services and actions of parallel_cal_msgs, as they are defined."""
    parts = [
        "# Messages, services and actions",
        "The definitions of `parallel_cal_msgs`. [The nodes](../ros.md) says which node uses them.",
    ]
    for kind in ("msg", "srv", "action"):
        parts.append(f"## parallel_cal_msgs/{kind}")
        for file in sorted((root / "msg_defs" / kind).glob(f"*.{kind}")):
            text = file.read_text(encoding="utf-8").strip()
            parts.append(f"### {file.stem}\n\n```text\n{text}\n```")
    return "\n\n".join(parts) + "\n"


# A room of the package, and what its public names are for.
ROOM_TITLES = {
    "model": "Models, and classes for your own mechanisms, effects and sensors",
    "recordings": "Recordings and samples",
    "identification": "Identification",
    "diagnosis": "Comparison and diagnosis",
    "discovery": "Laws without the catalogue",
    "session": "Adding effects, and sessions",
    "kinematics": "Kinematics",
    "planning": "Planning of measurements",
    "campaign": "Automatic calibration",
    "reporting": "Reports and pictures",
    "exporting": "Export",
    "base": "Errors and progress",
}


def python_names(root: Path) -> str:
    """The public names by the room that defines them, each with a page of its own."""
    stub = (root / "parallel_cal" / "__init__.pyi").read_text(encoding="utf-8")
    rooms: dict[str, list[str]] = {room: [] for room in ROOM_TITLES}
    for module, name in re.findall(r"^from \.([\w.]+) import (\w+) as \w+$", stub, re.M):
        rooms[module.split(".")[0]].append(name)
    title = "Python names"
    lines = [
        title,
        "=" * len(title),
        "",
        "``import parallel_cal as pc`` offers these names. :doc:`../python` shows them at work.",
        "",
        ".. currentmodule:: parallel_cal",
    ]
    for room, names in rooms.items():
        lines += ["", ROOM_TITLES[room], "-" * len(ROOM_TITLES[room]), ""]
        lines += [".. autosummary::", "   :toctree: python", ""]
        lines += [f"   {name}" for name in names]
    return "\n".join(lines) + "\n"
