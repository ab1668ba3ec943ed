"""One C++17 header for both problems and the Jacobians, without allocation or exceptions.

It contains the functions of the target c in a namespace, and a class that keeps what a controller
must remember. A program that checks it against Python's solutions comes with it.
"""

from __future__ import annotations

import re

from parallel_cal.exporting.targets import c
from parallel_cal.model.model import Model

MAKEFILE = """# Checks @robot@.hpp against @robot@_vectors.csv, Python's answers.
CXXFLAGS = -std=c++17 -O2 -Wall -Wextra -Wconversion -Wsign-conversion -Wpedantic -Werror

check: @robot@_check
\t./@robot@_check @robot@_vectors.csv

@robot@_check: @robot@_check.cpp @robot@.hpp
\t$(CXX) $(CXXFLAGS) $< -o $@
"""


def files(model: Model, name: str = "", poses: int = 1000) -> dict[str, str]:
    """Return the header, its check, build files and `poses` test vectors by file name.

    `name` is the namespace and the prefix of all names; the default is the mechanism's name.
    """
    made = c.files(model, name, poses)
    robot = next(file for file in made if file.endswith(".h")).removesuffix(".h")
    words = c.template_words(model, robot)
    embedded = _embed(made[f"{robot}.h"], made[f"{robot}.c"], words["ROBOT"])
    check = made[f"{robot}_check.c"].replace(
        f'#include "{robot}.h"', f'#include "{robot}.hpp"\nusing namespace {robot}::c;'
    )
    templates = {
        f"{robot}.hpp": c.read_template("robot.hpp"),
        "CMakeLists.txt": c.read_template("header_only.cmake"),
        "Makefile": MAKEFILE,
    }
    words["embedded"] = embedded
    written = {file: c.fill_template(text, words) for file, text in templates.items()}
    vectors = f"{robot}_vectors.csv"
    return written | {f"{robot}_check.cpp": check, vectors: made[vectors]}


def _embed(header: str, source: str, prefix: str) -> str:
    """Return both C files as the inside of a namespace in a header."""
    # The header without its guard and without `extern "C"`.
    inside = header.split(f"#define {prefix}_H\n")[1].rsplit("#endif", 1)[0]
    text = re.sub(r"#ifdef __cplusplus\n.*?#endif\n", "", inside, flags=re.S) + source
    text = re.sub(r"^#include .*\n", "", text, flags=re.M)
    text = re.sub(r"^extern [^;]*;.*\n", "", text, flags=re.M)
    # A constant instead of a macro, except those of the header, which initialise a structure.
    constant = rf"^#define (?!{prefix}_NEUTRAL)(\w+)[ ]+([^\s/].*?)[ ]*(/\*.*)?$"
    text = re.sub(constant, r"inline constexpr auto \1 = \2; \3", text, flags=re.M)
    text = re.sub(r"^(static )?const ", "inline constexpr ", text, flags=re.M)
    text = re.sub(r"^static inline |^static ", "inline ", text, flags=re.M)
    return re.sub(r"^(int|void) ", r"inline \1 ", text, flags=re.M)
