"""The journal of a campaign: one line for each target, sample and judgement."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ModelFileError, ParallelCalError
from parallel_cal.base.files import MEGABYTE, append_lines, json_lines, open_locked
from parallel_cal.campaign.cell import Sample
from parallel_cal.campaign.judging import Judgement
from parallel_cal.campaign.targets import Target
from parallel_cal.model.file.modelfile import dump_model, model_hash, parse_model, readable_text
from parallel_cal.recordings.dataset import Dataset

FILE = "campaign.jsonl"
MAX_JOURNAL_BYTES = 512 * MEGABYTE  # a larger journal is not read
LIMITS = ("joint_limits", "joint_rates", "keep_out")  # of the motion, in a mechanism


class CampaignError(ParallelCalError):
    """A campaign cannot start or continue."""


class Journal:
    """What was planned, measured and judged in a campaign's folder, which no other process may use.

    `model` is the text of the model file with which the campaign went on last. `targets` are
    numbered, because samples and what was `left_out` refer to them.
    """

    def __init__(self, folder: Path, model: str):
        self.path, self.model = folder / FILE, model
        self.is_update = False  # whether the campaign only updates a calibration
        self.targets: list[Target] = []
        self.samples: dict[int, Sample] = {}
        self.left_out: dict[int, str] = {}
        self.judgements: list[Judgement] = []
        self.warnings: list[str] = []
        self._ignored_targets: list[int] = []  # planned by judgements that are ignored
        self._begun, self._before = time.monotonic(), 0.0
        file = open_locked(self.path)
        if file is None:
            raise CampaignError(f"{folder}: another process uses this campaign")
        self._file = file
        for entry in json_lines(self.path, MAX_JOURNAL_BYTES):
            self._take(entry)

    def close(self) -> None:
        """Release the folder."""
        os.close(self._file)

    @property
    def spent(self) -> float:
        """Seconds so far, including earlier runs of this campaign."""
        return self._before + time.monotonic() - self._begun

    def write(self, **entry: Any) -> None:
        """Append a line and flush it to the disk."""
        entry["spent"] = self.spent
        append_lines(self._file, [json.dumps(to_json_value(entry), allow_nan=False)])

    def leave_out(self, k: int, why: str) -> None:
        """Leave a target out, and keep the reason."""
        self.left_out[k] = why
        self.write(left_out=k, why=why)

    def leave_out_ignored_targets(self) -> None:
        """The next judgement plans its own targets instead of those of ignored judgements."""
        for k in self._ignored_targets:
            if k not in self.samples and k not in self.left_out:
                self.leave_out(k, "planned by a judgement that is ignored")

    def _take(self, entry: Mapping[str, Any]) -> None:
        """Restore what a line states."""
        self._before = entry.get("spent", self._before)
        self.model = entry.get("model", self.model)
        if "begin" in entry:
            self.is_update = bool(entry["begin"].get("update"))
        self.targets += map(Target.from_document, entry.get("targets", ()))
        if "sample" in entry:
            dataset = Dataset.from_document(entry["sample"], FILE)
            self.samples[entry["target"]] = Sample(dataset, entry["start_ns"])
        if "left_out" in entry:
            self.left_out[entry["left_out"]] = entry["why"]
        if "judged" in entry:
            self._restore_judgement(entry["judged"])

    def _restore_judgement(self, document: Mapping[str, Any]) -> None:
        """Restore a judgement, or ignore it if its model cannot be read."""
        file, first = self.path, len(self.targets)
        # Samples refer to targets by number, so the targets of an ignored judgement count, too.
        self.targets += map(Target.from_document, document["targets"])
        try:
            judgement = Judgement.from_document(document)
            parse_model(
                judgement.text, f"{file}: model of the judgement of {judgement.samples} samples"
            )
        except ParallelCalError as error:
            why = str(error)
        except (KeyError, TypeError) as error:
            why = f"{file}: a judgement lacks keys that this release expects: {error!r}"
        else:
            self.judgements.append(judgement)
            self.warnings.clear()  # the samples of an ignored judgement have been judged again
            return
        self.warnings.append(f"{why}; this judgement is ignored and the samples are judged again")
        self._ignored_targets += range(first, len(self.targets))


def find_unfinished(folder: Path, model: str, update: bool = False) -> Path | None:
    """Return the newest unfinished campaign of a folder that started with this model, or with one
    that has other limits of the motion; only those that `update` a calibration, or only others."""
    for file in sorted(folder.glob(f"*/{FILE}"), reverse=True):
        # An iterator: a campaign of another model is read no further than its model.
        entries = json_lines(file, MAX_JOURNAL_BYTES)
        first: Mapping[str, Any] = next((e for e in entries if "model" in e), {})
        is_wanted = bool(first.get("begin", {}).get("update")) == update
        if not (is_wanted and is_same_but_for_limits(first.get("model", ""), model)):
            continue
        if not any("end" in e for e in entries):
            return file.parent
    return None


def is_same_but_for_limits(began: str, model: str) -> bool:
    """Return whether two texts of model files differ at most in the limits of the motion, which the
    owner of a robot may change during a campaign."""
    if model_hash(began) == model_hash(model):
        return True
    try:
        return model_hash(with_limits_of(began, model)) == model_hash(
            dump_model(parse_model(model))
        )
    except ModelFileError:
        return False


def with_limits_of(text: str, other: str) -> str:
    """Return the text of a model file with the limits of the motion (LIMITS) of another."""
    model, limits = parse_model(text), parse_model(other).mechanism
    if all(getattr(model.mechanism, name) == getattr(limits, name) for name in LIMITS):
        return text
    for name in LIMITS:
        setattr(model.mechanism, name, getattr(limits, name))
    return readable_text(model, "the model with the limits that were changed")
