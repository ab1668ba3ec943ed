"""Write the identified origins of a serial arm's joints into its own URDF.

Only origins change, and factors of `<mimic>` that were identified. Names, axes, limits, masses,
visuals and comments stay, byte for byte.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.exporting.arm_urdf import format_exactly, link_frames, moving_links, rpy_of
from parallel_cal.exporting.editing import read_verbatim
from parallel_cal.importing.chain import MAX_PARALLEL_SINE
from parallel_cal.importing.urdf import Joint, arm, read_chain
from parallel_cal.model.model import Model
from parallel_cal.recordings.recording import Array

ROUNDING_TOLERANCE = 1e-13  # m or 1; an origin that changes by less stays as it is
MAX_ITERATIONS = 20  # of Gauss and Newton's method with two unknowns
ARM_M = 0.1  # m, by which errors of directions count beside those of points
QUARTER_TURNS = (0.0, np.pi / 2, -np.pi / 2, np.pi)  # a model may count from another zero
DIGITS = 9  # of an error, m: of equal ones, the first start counts


def edit_arm(model: Model, path: Path) -> tuple[str, list[str]]:
    """Return the text of an arm's URDF with identified origins, and what changed.

    ModelError if its joints are not those of the model.
    """
    base, platform = (model.frames[name] for name in ("base", "platform"))
    try:
        chain = read_chain(path, base, platform)
    except DatasetError as error:
        raise ModelError(
            f"{error}. The model file names the links of both ends: frames: {{base: {base}, "
            f"platform: {platform}}}"
        ) from None
    _check_joints(model, path)
    moving = [joint for joint in chain if joint.kind]
    frames, tip = _place_frames(model, chain)
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


def _place_frames(model: Model, chain: Sequence[Joint]) -> tuple[list[Array], Array]:
    """Return the frame (4, 4) in the base of every moving joint of a file, and that of {P}, where
    the positions of all joints are zero.

    Each frame is where the file has it relative to the one before, but for the motion that brings
    it to its identified axis. A turn about this axis and a shift along it are free. They are such
    that the next axis is where the file has it: an error of an encoder's zero thus stays in the
    origin of its own joint, and turns or shifts the link behind it as a whole.
    """
    identified, tip = link_frames(model)
    at, placed = np.eye(4), list[Array]()
    for k, joint in enumerate(chain):
        at = at @ joint.origin
        if joint.kind:
            at = _bring_to_axis(at, joint, identified[len(placed)])
            target = _find_target(at, chain[k:], identified[len(placed) :], tip)
            at = target.turn_and_shift(at, joint)
            placed.append(at)
    return placed, tip


def _find_target(
    frame: Array, chain: Sequence[Joint], identified: Sequence[Array], tip: Array
) -> _Target:
    """Return where the link behind the first joint of a chain has to lead: to the next axis, or to
    the platform. A slide leads to the first axis that shows how far it is out."""
    ahead, following = np.eye(4), iter(identified[1:])
    for joint in chain[1:]:
        ahead = ahead @ joint.origin
        if joint.kind:
            target = _Target.axis(ahead, joint, next(following))
            shown = target.counted @ frame[:3, :3] @ chain[0].axis
            if chain[0].kind == "R" or np.linalg.norm(shown) > MAX_PARALLEL_SINE:
                return target
    return _Target.frame(ahead, tip)


@dataclass(frozen=True)
class _Target:
    """Where a link has to lead: directions (3, n) and a point in the frame of its joint, where they
    belong in the base, and in which directions the point counts."""

    directions: Array
    point: Array
    wanted_directions: Array
    wanted_point: Array
    counted: Array

    @classmethod
    def axis(cls, ahead: Array, joint: Joint, identified: Array) -> _Target:
        """Lead to the axis of a joint: to any point of one that turns, of a slide's to none."""
        u = identified[:3, 2]
        counted = np.eye(3) - np.outer(u, u) if joint.kind == "R" else np.zeros((3, 3))
        direction = (ahead[:3, :3] @ joint.axis)[:, None]
        return cls(direction, ahead[:3, 3], u[:, None], identified[:3, 3], counted)

    @classmethod
    def frame(cls, ahead: Array, tip: Array) -> _Target:
        """Lead to the frame of the platform."""
        return cls(ahead[:3, :3], ahead[:3, 3], tip[:3, :3], tip[:3, 3], np.eye(3))

    def turn_and_shift(self, frame: Array, joint: Joint) -> Array:
        """Return the frame of a turning joint turned about its axis, and of any joint shifted along
        it, so that the link leads to the target as well as possible."""
        axis = frame[:3, :3] @ joint.axis
        starts = QUARTER_TURNS if joint.kind == "R" else (0.0,)
        found = [self._approach(_screwed(frame, axis, turn, 0.0), axis, joint) for turn in starts]
        return min(found, key=lambda one: round(one[0], DIGITS))[1]

    def _approach(self, frame: Array, axis: Array, joint: Joint) -> tuple[float, Array]:
        """Return the error that is left (m) and the frame, by Gauss and Newton."""
        for _ in range(MAX_ITERATIONS):
            error, R = self._error(frame), frame[:3, :3]
            lever = R @ self.point
            turned = np.append(
                ARM_M * np.cross(axis, (R @ self.directions).T).ravel(),
                self.counted @ np.cross(axis, lever),
            )
            shifted = np.append(np.zeros(self.directions.size), self.counted @ axis)
            # Nearly parallel axes do not show a shift, and nearly equal ones no turn either.
            turned *= joint.kind == "R" and np.linalg.norm(turned) > MAX_PARALLEL_SINE * ARM_M
            shifted *= np.linalg.norm(shifted) > MAX_PARALLEL_SINE
            J = np.column_stack([turned, shifted])
            turn, shift = -np.linalg.lstsq(J, error)[0]
            frame = _screwed(frame, axis, turn, shift)
            if max(abs(turn), abs(shift)) < ROUNDING_TOLERANCE / 10:
                break
        return float(np.linalg.norm(self._error(frame))), frame

    def _error(self, frame: Array) -> Array:
        R, p = frame[:3, :3], frame[:3, 3]
        away = (R @ self.directions - self.wanted_directions).T.ravel()
        return np.append(ARM_M * away, self.counted @ (R @ self.point + p - self.wanted_point))


def _screwed(frame: Array, axis: Array, turn: float, shift: float) -> Array:
    """Return a frame turned about an axis through its origin and shifted along it."""
    found = frame.copy()
    found[:3, :3] = rotation_matrix(turn * axis) @ frame[:3, :3]
    found[:3, 3] += shift * axis
    return found


def _bring_to_axis(frame: Array, joint: Joint, identified: Array) -> Array:
    """Return the frame of a joint after the shortest motion to its identified axis."""
    axis, point = identified[:3, 2], identified[:3, 3]
    before, found = frame[:3, :3] @ joint.axis, frame.copy()
    normal, cosine = np.cross(before, axis), float(before @ axis)
    sine = float(np.linalg.norm(normal))
    if sine == 0 and cosine < 0:  # any normal
        normal = np.cross(before, np.eye(3)[np.argmin(np.abs(before))])
    length = float(np.linalg.norm(normal)) or 1.0
    found[:3, :3] = rotation_matrix(np.arctan2(sine, cosine) * normal / length) @ frame[:3, :3]
    if joint.kind == "R":
        found[:3, 3] = point + axis * (axis @ (frame[:3, 3] - point))
    return found


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
        stop = begin + len(_start_tag(content[begin:]))
        if at is None:
            attributes = " ".join(f'{key}="{value}"' for key, value in words.items())
            changes.append((stop, stop, f"<{part} {attributes}/>"))
        else:
            changes.append((begin, stop, _with_attributes(content[begin:stop].decode(), words)))
    for begin, stop, new in sorted(changes, reverse=True):
        content = content[:begin] + new.encode() + content[stop:]
    return text[:lead] + content.decode()


def _start_tag(content: bytes) -> bytes:
    """Return the start tag at the beginning of a text; `>` may be within quotes."""
    found: Any = re.match(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""", content)
    return found[0]  # type: ignore[no-any-return]


def _with_attributes(tag: str, words: Mapping[str, str]) -> str:
    """Return a start tag with other values of some attributes."""
    for key, value in words.items():
        pattern = rf"""(\s{key}\s*=\s*)("[^"]*"|'[^']*')"""
        if re.search(pattern, tag):
            tag = re.sub(pattern, lambda found, new=value: f'{found[1]}"{new}"', tag)
        else:
            tag = re.sub(r"\s*(/?>)$", lambda found, new=f' {key}="{value}"': new + found[1], tag)
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
