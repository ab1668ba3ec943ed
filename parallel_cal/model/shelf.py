"""The shelves: plug-ins by file name, or a user's own by Python path."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any

from parallel_cal.base.documents import to_plain
from parallel_cal.base.errors import (
    ModelError,
    ParallelCalError,
    format_suggestion,
    wrap_plugin_error,
)
from parallel_cal.model.declaration import check
from parallel_cal.model.effect import Effect
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.sensor import Sensor

# Shelves that go on in another room: what only the tables of the documents need.
CONTINUED = {
    "kinematics.solvers": "thesis.solvers",
    "identification.methods": "thesis.methods",
}
_own_allowed = True
_own_folders: list[Path] = []  # with plug-ins of the user, besides those on the Python path


def forbid_foreign() -> None:
    """Forbid imports by Python path from outside the package, for the rest of the process."""
    global _own_allowed
    _own_allowed = False


def require_allowed(path: str, error: type[ParallelCalError] = ModelError) -> None:
    """Raise `error` for a module from outside the package if these are forbidden."""
    if not _own_allowed and not path.startswith("parallel_cal."):
        raise error(
            f"{path}: modules from outside the package are not imported here; to "
            "allow them, set the node's parameter allow_foreign_modules"
        )


def add_plugin_folder(folder: Path) -> None:
    """Load plug-ins NAME.py of a folder by their name, for the rest of the process.

    The folder is not on the Python path, so its files replace no other module.
    """
    if (folder := folder.resolve()) not in _own_folders:
        _own_folders.append(folder)


def load_mechanism(name: str, /, **options: Any) -> Mechanism:
    """Load a mechanism by file name (`delta54`) or Python path (`my_pkg.my_robot`)."""
    options = to_plain(options)
    cls = load_class("mechanisms", name, Mechanism)
    try:
        signature(cls).bind(**options)
    except TypeError as error:
        names = list(signature(cls).parameters)
        unknown = [option for option in options if option not in names]
        why = str(error)
        if unknown:
            why = f"there is no option '{unknown[0]}'{format_suggestion(unknown[0], names)}"
        takes = ", ".join(options_of(cls)) or "none"
        raise ModelError(f"{name}: {why}; its options: {takes}") from None
    try:
        mechanism = cls(**options)
        check(mechanism)
    except Exception as error:
        raise wrap_plugin_error(name, error) from error
    mechanism.options = {**options, **mechanism.options}  # and those that it has chosen itself
    return mechanism


def load_effect(name: str) -> Effect:
    """Load an effect by file name (`backlash`) or Python path (`my_pkg.my_effect`)."""
    cls = load_class("effects", name, Effect)
    try:
        return cls()
    except Exception as error:
        raise wrap_plugin_error(name, error) from error


def load_sensor(name: str, **options: Any) -> Sensor:
    """Load a sensor by file name (`plane_spheres`) or Python path; its fields are the options."""
    try:
        return load_class("sensors", name, Sensor)(**to_plain(options))
    except TypeError as error:
        raise ModelError(f"sensor {name}: {error}") from None


def load_class(shelf: str, name: str, base: type) -> type:
    """Load the one subclass of `base` in parallel_cal/<shelf>/<name>.py or at a Python path."""
    module = load_module(shelf, name)
    found = [
        member
        for member in vars(module).values()
        if isinstance(member, type)
        and issubclass(member, base)
        and member.__module__ == module.__name__  # not imported there
        and not member.__name__.startswith("_")
    ]
    if len(found) != 1:
        raise ModelError(
            f"{module.__name__} defines {len(found)} subclasses of {base.__name__}, expected 1"
        )
    return found[0]


def load_module(shelf: str, name: str, error: type[ParallelCalError] = ModelError) -> ModuleType:
    """Load parallel_cal/<shelf>/<name>.py, the module at a Python path, or a file NAME.py on the
    Python path or in a folder of `add_plugin_folder`; `error` for none of them."""
    more = CONTINUED.get(shelf)
    place = more if more and name in _list_files(more) else shelf
    path = name if "." in name else f"parallel_cal.{place}.{name}"
    require_allowed(path, error)
    try:
        if path.startswith(".") or name.startswith("_"):  # a path of files; no public name
            raise ModuleNotFoundError(name=path)
        return import_module(path)
    except ModuleNotFoundError as missing:
        if missing.name is None or not path.startswith(missing.name):
            raise wrap_plugin_error(path, missing) from missing
        if path != name and (spec := _find_own_file(name)) is not None:
            return _load_own_file(spec, error)
        names = list_plugins(shelf)
        raise error(
            f"no {shelf.split('.')[-1].rstrip('s')} '{name}': expected one of "
            f"{', '.join(names)}, or the Python path of your own "
            f"(my_pkg.my_file){format_suggestion(name, names)}"
        ) from None
    except Exception as raised:
        raise wrap_plugin_error(path, raised) from raised


def _find_own_file(name: str) -> ModuleSpec | None:
    """Find NAME.py outside any package: on the Python path, such as in the present folder, or in a
    folder of `add_plugin_folder`."""
    if not name.isidentifier() or name.startswith("_") or name in sys.stdlib_module_names:
        return None
    spec = find_spec(name)
    if spec is not None:
        return spec if (spec.origin or "").endswith(f"{name}.py") else None
    files = [folder / f"{name}.py" for folder in _own_folders]
    file = next((one for one in files if one.is_file()), None)
    return None if file is None else spec_from_file_location(name, file)


def _load_own_file(spec: ModuleSpec, error: type[ParallelCalError]) -> ModuleType:
    require_allowed(spec.name, error)
    if spec.name in sys.modules:
        return sys.modules[spec.name]
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        assert spec.loader is not None  # a file NAME.py has one
        spec.loader.exec_module(module)
    except Exception as raised:
        del sys.modules[spec.name]
        raise wrap_plugin_error(spec.name, raised) from raised
    return module


def wrap_plugin_function(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function of a user's own file: its exceptions become one line that says where."""
    if "." not in name:
        return function

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        try:
            return function(*arguments, **options)
        except ParallelCalError:
            raise
        except Exception as error:
            raise wrap_plugin_error(name, error) from error

    return call


def list_plugins(shelf: str) -> list[str]:
    """The public names on a shelf: its file names."""
    more = CONTINUED.get(shelf)
    return sorted(_list_files(shelf) | (_list_files(more) if more else set()))


def _list_files(shelf: str) -> set[str]:
    """The public names of one folder of a shelf."""
    from pkgutil import iter_modules

    package = import_module(f"parallel_cal.{shelf}")
    return {m.name for m in iter_modules(package.__path__) if not m.name.startswith("_")}


def options_of(cls: type) -> list[str]:
    """The options of a mechanism or sensor: `links`, or with its default `radius=0.1`."""
    return [str(p.replace(annotation=p.empty)) for p in signature(cls).parameters.values()]
