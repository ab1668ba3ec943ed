"""A sensor from its entry in a model file: the options are the fields of its class."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from pydantic import TypeAdapter, ValidationError

from parallel_cal.base.errors import ModelError
from parallel_cal.model.file.schema import OwnNumberPart, sentence, suggestion
from parallel_cal.model.file.yamltext import Document, Path
from parallel_cal.model.parameters import ParameterTable
from parallel_cal.model.sensor import Sensor
from parallel_cal.model.shelf import load_class


def read_sensor(document: Document, path: Path, name: str, options: Mapping[str, Any]) -> Sensor:
    """Make the sensor `name` with options from YAML; ModelFileError names the key of a bad one.

    ModelError if there is no such sensor.
    """
    made = load_class("sensors", name, Sensor)
    known = [field.name for field in fields(made)]
    for key in options:
        if key not in known:
            raise document.error((*path, key), f"unknown option{suggestion(key, known)}")
    try:
        text = json.dumps(options, allow_nan=False)
        # Strict JSON: a number is a number, but a list may become a tuple.
        return TypeAdapter(made).validate_json(text, strict=True)  # type: ignore[no-any-return]
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise document.error((*path, *first["loc"]), sentence(first, first["loc"])) from None
    except ModelError as error:
        raise document.error(path, str(error)) from None
    except ValueError:
        raise document.error(path, "a number is not finite") from None


def own_numbers(sensor: Sensor, table: ParameterTable) -> dict[str, OwnNumberPart]:
    """Return nominal parameters for a sensor whose entry gives none; known ones are fixed."""
    fixed = table.matching(sensor.fixed_patterns())
    return {
        p.name.removeprefix(f"{sensor.name}."): OwnNumberPart(
            value=p.nominal, unit=p.unit, fixed=bool(known)
        )
        for p, known in zip(table, fixed, strict=True)
    }
