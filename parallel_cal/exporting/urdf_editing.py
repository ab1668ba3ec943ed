"""Write the identified origins of a serial arm's joints into its own URDF.

Only origins change, and factors of `<mimic>` that were identified. Names, axes, limits, masses,
visuals and comments stay, byte for byte.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.exporting.arm_urdf import format_exactly, link_frames, moving_links, rpy_of
from parallel_cal.exporting.editing import read_verbatim
from parallel_cal.exporting.frame_placement import place_frames
from parallel_cal.importing.mimic import Joint
from parallel_cal.importing.urdf import arm, read_chain, read_links
from parallel_cal.model.model import Model

Array = np.ndarray
START_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")  # `>` may be within quotes
ROUNDING_TOLERANCE = 1e-13  # m or 1; an origin that changes by less stays as it is


def edit_arm(model: Model, path: Path) -> tuple[str, list[str]]:
    """Return the text of an arm's URDF with identified origins, and what changed.

    ModelError if its joints are not those of the model.
    """
    base, platform = (model.frames[name] for name in ("base", "platform"))
    links = read_links(path)
    if missing := [name for name in (base, platform) if name not in links]:
        raise ModelError(
            f"{path}: no link '{missing[0]}', expected one of {', '.join(links)}. The model file "
            f"names the links of both ends: frames: {{base: {base}, platform: {platform}}}"
        )
    chain = read_chain(path, base, platform)
    _check_joints(model, path)
    moving = [joint for joint in chain if joint.kind]
    identified, tip = link_frames(model)
    frames = place_frames(chain, identified, tip)
    origins, at, placed = dict[str, Array](), np.eye(4), iter(frames)
    for joint in chain:
        after = next(placed) if joint.kind else at @ joint.origin
        if joint is chain[-1] and not (joint.kind or joint.mimic):  # a fixed joint leads to {P}
            after = tip
        origins[joint.name] = np.linalg.solve(at, after)
        at = after
    changed = {
        joint.name: origins[joint.name]
        for joint in chain
        if np.abs(origins[joint.name] - joint.origin).max() > ROUNDING_TOLERANCE
    }
    edits = {name: _origin_words(origin) for name, origin in changed.items()}
    text = read_verbatim(path)
    text = edit_elements(text, "origin", edits)
    text = edit_elements(text, "mimic", factors := _find_new_factors(model, moving))
    remarks = _describe(chain, changed)
    if factors:
        remarks.append(f"the mimics of {', '.join(factors)} have identified factors")
    if not np.allclose(at, tip, rtol=0, atol=ROUNDING_TOLERANCE):
        text = _insert_tip(text, chain[-1], np.linalg.solve(at, tip))
        remarks.append(
            f"{chain[-1].name} now moves a new link {platform}_axis, to which {platform} is fixed: "
            "the identified frame is beside the axis of this joint"
        )
    return text, remarks


def _check_joints(model: Model, path: Path) -> None:
    """Refuse a file whose chain has other joints than the model, or other mimics."""
    own = arm(path, model.frames["base"], model.frames["platform"]).model
    (names, its), (others, theirs) = (
        (m.joints, [(link.joint, [*factors]) for link, factors in moving_links(m)])
        for m in (model, own)
    )
    if names != others or its != theirs:
        shown = [
            f"{', '.join(m.joints)} ({''.join(kind or '' for kind, _ in steps)})"
            for m, steps in ((model, its), (own, theirs))
        ]
        raise ModelError(
            f"{path}: its joints from '{model.frames['base']}' to '{model.frames['platform']}' are "
            f"{shown[1]}, but the model has {shown[0]}: expected the file from which the model "
            "was made (new --from), or a model file whose joints have the file's names"
        )


def _origin_words(origin: Array) -> dict[str, str]:
    return {
        "xyz": format_exactly(origin[:3, 3]),
        "rpy": format_exactly(rpy_of(origin[:3, :3])),
    }


def _find_new_factors(model: Model, moving: Sequence[Joint]) -> dict[str, dict[str, str]]:
    """Return the mimics of the chain if a factor was identified.

    All of them then follow their first master, because a follower in between has another factor.
    """
    followers = [
        (joint, joint.mimic, factors[joint.mimic.joint])
        for joint, (_, factors) in zip(moving, moving_links(model), strict=True)
        if joint.mimic
    ]
    if all(factor == mimic.factor for _, mimic, factor in followers):
        return {}
    return {
        joint.name: {
            "joint": mimic.joint,
            "multiplier": format_exactly((factor,)),
            "offset": format_exactly((mimic.offset,)),
        }
        for joint, mimic, factor in followers
    }


def _describe(chain: Sequence[Joint], changed: Mapping[str, Array]) -> list[str]:
    """Say how far the origins moved, and which most."""
    if not changed:
        return ["no origin changed"]
    moved = {
        joint.name: np.linalg.solve(joint.origin, changed[joint.name])
        for joint in chain
        if joint.name in changed
    }
    shift = {name: float(np.linalg.norm(T[:3, 3])) for name, T in moved.items()}
    turn = {name: float(np.linalg.norm(rotation_vector(T[:3, :3]))) for name, T in moved.items()}
    far, wide = max(shift, key=shift.__getitem__), max(turn, key=turn.__getitem__)
    return [
        f"origins changed: {len(changed)}, by up to {1e3 * shift[far]:.3g} mm ({far}) and "
        f"{np.degrees(turn[wide]):.3g} deg ({wide})"
    ]


# ------------------------------------------------------------------ the text


@dataclass
class _Places:
    """Where the start tags of joints, and of one of their parts, are in an XML text (bytes)."""

    part: str
    joints: dict[str, int] = field(default_factory=dict)
    parts: dict[str, int] = field(default_factory=dict)
    _open: list[str] = field(default_factory=list)

    @classmethod
    def find(cls, content: bytes, part: str) -> _Places:
        places, parser = cls(part), expat.ParserCreate()

        def begin(tag: str, attributes: Mapping[str, str]) -> None:
            places._open.append(tag)
            if places._open == ["robot", "joint"]:
                places._name = attributes.get("name", "")
                places.joints[places._name] = parser.CurrentByteIndex
            elif places._open == ["robot", "joint", part]:
                places.parts[places._name] = parser.CurrentByteIndex

        def end(tag: str) -> None:
            places._open.pop()

        parser.StartElementHandler, parser.EndElementHandler = begin, end
        parser.Parse(content, True)
        return places

    _name: str = ""


def edit_elements(text: str, part: str, edits: Mapping[str, Mapping[str, str]]) -> str:
    """Return the text with new attributes in one part of joints, by the names of the joints."""
    lead = len(text) - len(text.lstrip("\ufeff \t\r\n"))
    content = text[lead:].encode()
    places = _Places.find(content, part)
    changes = list[tuple[int, int, str]]()
    for name, words in edits.items():
        at = places.parts.get(name)
        begin = places.joints[name] if at is None else at
        stop = begin + START_TAG.match(content[begin:]).end()  # type: ignore[union-attr]
        if at is None:
            attributes = " ".join(f'{key}="{value}"' for key, value in words.items())
            changes.append((stop, stop, f"<{part} {attributes}/>"))
        else:
            changes.append((begin, stop, _with_attributes(content[begin:stop].decode(), words)))
    for begin, stop, new in sorted(changes, reverse=True):
        content = content[:begin] + new.encode() + content[stop:]
    return text[:lead] + content.decode()


def _with_attributes(tag: str, words: Mapping[str, str]) -> str:
    """Return a start tag with other values of some attributes."""
    for key, value in words.items():
        found = re.search(rf"""\s{key}\s*=\s*("[^"]*"|'[^']*')""", tag)
        begin, stop = found.span() if found else (len(tag.rstrip("/> \t\r\n")),) * 2
        tag = f'{tag[:begin]} {key}="{value}"{tag[stop:]}'
    return tag


def _insert_tip(text: str, joint: Joint, origin: Array) -> str:
    """Return the text in which the last joint moves a new link, to which its link is fixed."""
    new = f"{joint.child}_axis"
    while f'"{new}"' in text:
        new += "_"
    text = edit_elements(text, "child", {joint.name: {"link": new}})
    words = " ".join(f'{key}="{value}"' for key, value in _origin_words(origin).items())
    line = "\r\n" if "\r\n" in text else "\n"
    added = (
        f'  <link name="{new}"/>\n'
        f'  <joint name="{new}_fixed" type="fixed">\n'
        f'    <parent link="{new}"/>\n    <child link="{joint.child}"/>\n'
        f"    <origin {words}/>\n  </joint>\n"
    )
    end = text.rindex("</robot")
    return text[:end] + added.replace("\n", line) + text[end:]
