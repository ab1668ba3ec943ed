"""YAML text <-> plain data, with the line of every key and numbers that survive exactly.

Scalars follow YAML 1.2 (`1e-5` is a number, `on` a word), unlike PyYAML.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from parallel_cal.base.documents import to_plain
from parallel_cal.base.errors import ModelFileError

Path = tuple[str | int, ...]

WORDS: dict[str, Any] = {"": None, "~": None, "null": None, "true": True, "false": False}
NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
WHOLE = re.compile(r"[-+]?[0-9]+")
NOT_FINITE = re.compile(r"[-+]?\.?(inf|infinity|nan)", re.IGNORECASE)
PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./+-]*( [A-Za-z0-9_./+-]+)*")
MAX_DEPTH = 30  # levels; a model file has six, and parsers are recursive
MAX_DIGITS = 18  # of a whole number, without its sign: more do not fit in 64 bits
AMBIGUOUS = {"null", "true", "false", "yes", "no", "on", "off", "y", "n", "nan", "inf", "infinity"}


@dataclass(frozen=True)
class Document:
    """Plain data of a YAML text and the line (from 1) of every key and list item."""

    name: str
    data: Any
    lines: Mapping[Path, int]

    def line(self, path: Path) -> int:
        """Return the line of a key, or of the nearest key around it."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)

    def error(self, path: Path, text: str) -> ModelFileError:
        """Make an error that names file, line and key."""
        key = ".".join(str(part) for part in path)
        where = f"{self.name}:{self.line(path)}: "
        return ModelFileError(f"{where}{key}: {text}" if key else where + text)


def parse_yaml(text: str, name: str) -> Document:
    """Parse a text; ModelFileError if it is not YAML or a key occurs twice."""
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_depth(yaml.parse(text, Loader=loader), name)
        root = yaml.compose(text, Loader=loader)
    except UnicodeEncodeError:  # an argument of the command line that is not UTF-8
        raise ModelFileError(f"{name}:1: not YAML: it is not text (UTF-8)") from None
    except yaml.YAMLError as error:
        # libyaml reads ahead and has a limit of its own; PyYAML's parser finds the level.
        with suppress(yaml.YAMLError):
            _check_depth(yaml.parse(text, Loader=yaml.SafeLoader), name)
        mark = getattr(error, "problem_mark", None)
        line = mark.line + 1 if mark else 1
        why = getattr(error, "problem", None) or str(error).replace("\n", " ")
        raise ModelFileError(f"{name}:{line}: not YAML: {why}") from None
    if root is None:
        raise ModelFileError(f"{name}:1: the file is empty; create one with 'parallel-cal new'")
    lines: dict[Path, int] = {}
    return Document(name, _Builder(name, lines).value(root, ()), lines)


def _check_depth(events: Iterable[Any], name: str) -> None:
    """Check the depth without recursion, as YAML events arrive one by one (ModelFileError)."""
    depth = 0
    for event in events:
        kind = type(event).__name__
        depth += kind.endswith(("MappingStartEvent", "SequenceStartEvent"))
        depth -= kind.endswith(("MappingEndEvent", "SequenceEndEvent"))
        if depth > MAX_DEPTH:
            line = event.start_mark.line + 1
            raise ModelFileError(f"{name}:{line}: nested more than {MAX_DEPTH} levels deep")


class _Builder:
    """Plain data from YAML nodes."""

    def __init__(self, name: str, lines: dict[Path, int]):
        self._name, self._lines = name, lines
        self._seen: set[int] = set()

    def value(self, node: Any, path: Path) -> Any:
        self._lines.setdefault(path, node.start_mark.line + 1)
        # An alias may contain itself; a model file does not need one.
        if id(node) in self._seen or not node.tag.startswith("tag:yaml.org,2002:"):
            raise self._error(path, "YAML aliases (*name) and custom tags (!name) are not allowed")
        self._seen.add(id(node))
        if node.id == "mapping":
            return dict(self._items(node, path))
        if node.id == "sequence":
            return [self.value(item, (*path, i)) for i, item in enumerate(node.value)]
        digits = len(node.value.lstrip("+-"))
        if digits > MAX_DIGITS and not node.style and WHOLE.fullmatch(node.value):
            raise self._error(
                path, f"a whole number has {digits} digits, expected at most {MAX_DIGITS}"
            )
        return _scalar(node)

    def _items(self, node: Any, path: Path) -> Iterator[tuple[str, Any]]:
        done: set[str] = set()
        for key, item in node.value:
            if key.id != "scalar":
                raise self._error(path, "a key must be one word or number")
            inside = (*path, key.value)
            if key.value in done:
                first = self._lines[inside]
                self._lines[inside] = key.start_mark.line + 1
                raise self._error(inside, f"the key occurs twice; it is first in line {first}")
            done.add(key.value)
            self._lines[inside] = key.start_mark.line + 1
            yield key.value, self.value(item, inside)

    def _error(self, path: Path, text: str) -> ModelFileError:
        return Document(self._name, None, self._lines).error(path, text)


def _scalar(node: Any) -> Any:
    text = node.value
    if node.style:  # quoted or a block; plain is None or '', depending on the loader
        return text
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    if WHOLE.fullmatch(text):
        return int(text)
    if NUMBER.fullmatch(text):
        return float(text)
    if NOT_FINITE.fullmatch(text):
        return float(text.replace(".", ""))
    return text


def flow(value: Any) -> str:
    """Format a value on one line; floats like Python's repr, which reads back to the same bits."""
    value = to_plain(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{flow(str(k))}: {flow(v)}" for k, v in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(flow(v) for v in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ModelFileError(f"a model file cannot contain the number {value}")
        text = repr(value)
        # YAML 1.1 readers take `1e-05` for a word.
        return text.replace("e", ".0e") if "e" in text and "." not in text else text
    text = str(value)
    plain = PLAIN.fullmatch(text) and text.lower() not in AMBIGUOUS
    if plain:
        return text
    text = text.encode(errors="backslashreplace").decode()  # a file name that is not UTF-8
    # YAML forbids some characters that JSON leaves as they are, and folds others (U+2028).
    quoted = json.dumps(text, ensure_ascii=False)
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in quoted)
