"""Fleets on the disk: the virtual workshop's robots, each a folder's or a list's."""

from pathlib import Path

import virtual_fleet as vf
from datasets import as_dataset

ROOT = Path(__file__).parents[2]
NOMINAL = ROOT / "config" / "delta_mockup_nominal.yaml"


def written(folder, members, recordings=1, days=10.0, **session):
    """A list of the members' recordings, so many days apart: sample files beside one model."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "delta.yaml").write_text(NOMINAL.read_text())
    lines = ["robot,model,recording,time"]
    for member in members:
        for k in range(recordings):
            name = f"{member.name}/{k}.json"
            (folder / member.name).mkdir(exist_ok=True)
            samples = member.measured(k, k * days * vf.DAY, **session)
            as_dataset(samples).to_json(folder / name)
            day = 1 + int(k * days)
            lines.append(f"{member.name},delta.yaml,{name},2026-01-{day:02d}T12:00")
    (folder / "fleet.csv").write_text("\n".join(lines) + "\n")
    return folder / "fleet.csv"
