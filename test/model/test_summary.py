"""What a model file describes, and the command that writes it for its controller."""

from dataclasses import replace

import pytest

from parallel_cal.model.model import new_model
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
