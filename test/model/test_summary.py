"""What a model file describes, and the command that writes it for its controller."""

from dataclasses import replace

import pytest

from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.model.summary import export_command

FROM = {"step": "new", "controller": "klipper", "files": ["printer.cfg", "my delta.cfg"]}


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (FROM, "--to klipper --into printer.cfg --into 'my delta.cfg'"),
        (FROM | {"controller": "marlin", "files": ["a.log"]}, "--to marlin -o marlin"),
        (FROM | {"controller": "universal_robots"}, ""),
        ({"step": "fit"}, ""),
    ],
)
def test_a_model_of_a_firmwares_files_names_the_export_into_them(origin, command):
    """What a controller printed cannot be given back to it, and not every one has an export."""
    model = replace(new_model("linear_delta"), history=(origin, {"step": "fit"}))
    whole = f"parallel-cal export m.yaml {command}" if command else ""
    assert export_command(model, "m.yaml") == whole


def test_touches_are_named_where_an_export_does_not_find_them_itself():
    """A log cannot be edited: -o writes commands, and compares heights at the touches it gets."""
    probe = load_sensor("probe", height=0.0, sigma=None)
    log = {"step": "new", "controller": "marlin", "files": ["a.log"]}
    fit = {"step": "fit", "dataset": {"files": ["touches.json", "more.json"]}}
    model = replace(new_model("linear_delta", sensors=(probe,)), history=(log, fit))
    command = "parallel-cal export m.yaml --to marlin -o marlin"
    touches = " --touches touches.json --touches more.json"
    assert export_command(model, "m.yaml") == command + touches
    plain = replace(new_model("linear_delta"), history=(log, fit))
    assert export_command(plain, "m.yaml") == command
    edited = replace(model, history=(FROM, fit))
    assert "--touches" not in export_command(edited, "m.yaml")
