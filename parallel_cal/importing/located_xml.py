"""The elements of an XML text, and where each stands in it: read them, and edit their numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import read_text

Array = np.ndarray

START_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")  # `>` may be within quotes


@dataclass
class Element:
    """An element of an XML file, with the byte at which it begins and its line."""

    path: Path
    tag: str
    attributes: dict[str, str]
    line: int
    begin: int
    parent: Element | None = None
    children: list[Element] = field(default_factory=list)
    text: str = ""

    @property
    def where(self) -> str:
        """File, line and start tag, as errors name an element."""
        name = self.attributes.get("name")
        label = f"<{self.tag} name='{name}'>" if name else f"<{self.tag}>"
        return f"{self.path}:{self.line}: {label}"

    def find(self, tag: str) -> Element | None:
        """Return the first child with a tag."""
        return next((one for one in self.children if one.tag == tag), None)

    def all(self, *tags: str) -> list[Element]:
        """Return the children with one of these tags."""
        return [one for one in self.children if one.tag in tags]

    def walk(self) -> Iterator[Element]:
        """Yield this element and all below it, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.walk()

    def get(self, key: str, default: str = "") -> str:
        """Return an attribute."""
        return self.attributes.get(key, default)

    def required(self, key: str) -> str:
        """Return an attribute; DatasetError if it is missing."""
        if not self.attributes.get(key):
            raise DatasetError(f"{self.where}: no {key}, expected {key}='...'")
        return self.attributes[key]

    def numbers(self, key: str, n: int, default: str) -> Array:
        """Return an attribute of n numbers."""
        return to_numbers(self.where, key, self.attributes.get(key, default), n)


def to_numbers(where: str, key: str, text: str, n: int) -> Array:
    """Return n finite numbers from a text; DatasetError names the place."""
    try:
        found = np.array(text.split(), float)
    except ValueError:
        found = np.empty(0)
    if found.shape != (n,) or not np.isfinite(found).all():
        words = "a number" if n == 1 else f"{n} numbers"
        raise DatasetError(f"{where}: {key} is '{text.strip()}', expected {words}")
    return found


def read_xml(path: Path, kind: str) -> Element:
    """Return the root element of a file; DatasetError if it is no XML or contains xacro."""
    try:
        content = read_text(path)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: not a {kind}: {error}") from None
    root = parse_xml(path, content, kind)
    for part in root.walk():
        if part.tag.startswith("xacro:"):
            raise DatasetError(
                f"{part.where}: the file is a xacro: expand it first (xacro {path.name} > "
                f"robot.urdf) and give the expanded file"
            )
    return root


def parse_xml(path: Path, content: str, kind: str) -> Element:
    """Return the root element of a text."""
    head, body = split_lead(content)
    first, data = head.count("\n"), body.encode()
    parser = expat.ParserCreate("utf-8")
    above = list[Element]()
    roots = list[Element]()

    def begin(tag: str, attributes: Mapping[str, str]) -> None:
        line, at = first + parser.CurrentLineNumber, parser.CurrentByteIndex
        one = Element(path, tag, dict(attributes), line, at, above[-1] if above else None)
        (above[-1].children if above else roots).append(one)
        above.append(one)

    def add_text(text: str) -> None:
        if above:
            above[-1].text += text

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: above.pop()
    parser.CharacterDataHandler = add_text
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise DatasetError(f"{path}: not a {kind}: {error}") from None
    return roots[0]


def split_lead(content: str) -> tuple[str, str]:
    """Split what XML does not allow before its declaration, but files have there: a byte order
    mark, blank lines and comments."""
    at = content.find("<?xml")
    if at < 0 or content[:at].strip("\ufeff \t\r\n") == "":
        at = len(content) - len(content.lstrip("\ufeff \t\r\n"))
    return content[:at], content[at:]


@dataclass
class XmlEdit:
    """New values for attributes and texts of elements; everything else stays byte for byte."""

    attributes: list[tuple[Element, str, str]] = field(default_factory=list)
    texts: list[tuple[Element, str]] = field(default_factory=list)
    parts: list[tuple[Element, str]] = field(default_factory=list)

    def set(self, element: Element, key: str, value: str) -> None:
        """State a new value of an attribute."""
        self.attributes.append((element, key, value))

    def rename(self, element: Element, old: str, key: str, value: str) -> None:
        """State a new value of an attribute under another name."""
        self.attributes.append((element, f"{old}>{key}" if old != key else key, value))

    def set_text(self, element: Element, value: str) -> None:
        """State a new text of an element without children."""
        self.texts.append((element, value))

    def insert(self, element: Element, part: str) -> None:
        """Add a part as the first child of an element that has a start and an end tag."""
        self.parts.append((element, part))

    def apply(self, content: str) -> str:
        """Return the text of the file with the new values."""
        head, body = split_lead(content)
        data = body.encode()
        tags: dict[int, str] = {}
        for element, key, value in self.attributes:
            tag = tags.get(element.begin) or _start_tag(data, element)
            old, _, new = key.rpartition(">")
            if old:
                tag = re.sub(rf"(\s){re.escape(old)}(\s*=)", rf"\g<1>{new}\g<2>", tag, count=1)
            tags[element.begin] = with_attribute(tag, new, value)
        changes = [
            (begin, begin + START_TAG.match(data[begin:]).end(), new)  # type: ignore[union-attr]
            for begin, new in tags.items()
        ]
        for element, value in self.texts:
            begin = element.begin + len(_start_tag(data, element).encode())
            stop = data.index(b"<", begin)
            changes.append((begin, stop, value))
        for element, part in self.parts:
            at = element.begin + len(_start_tag(data, element).encode())
            changes.append((at, at, part))
        for begin, stop, new in sorted(changes, reverse=True):
            data = data[:begin] + new.encode() + data[stop:]
        return head + data.decode()


def _start_tag(data: bytes, element: Element) -> str:
    return START_TAG.match(data[element.begin :])[0].decode()  # type: ignore[index]


def with_attribute(tag: str, key: str, value: str) -> str:
    """Return a start tag with another value of an attribute, which is added if it is missing."""
    found = re.search(rf"""(\s{re.escape(key)}\s*=\s*)("[^"]*"|'[^']*')""", tag)
    if found:
        quote = found[2][0]
        return f"{tag[: found.start()]}{found[1]}{quote}{value}{quote}{tag[found.end() :]}"
    at = len(tag.rstrip("/> \t\r\n"))
    return f'{tag[:at]} {key}="{value}"{tag[at:]}'
