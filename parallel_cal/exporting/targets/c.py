"""C99 source and header for both problems and the Jacobians, without dependency or allocation.

With them come a program that checks them against Python's solutions, and an example of a
controller's loop.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files as resources
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal import __version__
from parallel_cal.base.compiled import Single, dense
from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.exporting.targets._vectors import vectors
from parallel_cal.kinematics.branch import (
    FIRST_SHARE,
    MAX_BEND,
    MAX_PATH_STEPS,
    MIN_STEP_FRACTION,
    PATH_GROWTH,
    SAME_SOLUTION,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.newton import NewtonFunctions, newton_functions, short_step
from parallel_cal.kinematics.problem import (
    MAX_DESCENT_STEPS,
    MAX_SLOW_SHARE,
    SLOW_STEPS,
    Problem,
)
from parallel_cal.kinematics.rows import LIMIT_ROUNDING
from parallel_cal.kinematics.solutions import (
    MAX_CLOSED_RESIDUAL_M,
    MAX_SETTLED_STEP_M,
    MIN_REGULAR_SINGULAR_VALUE,
    SUSPECT_PIVOT,
)
from parallel_cal.kinematics.split_turns import free_turn, splits_turns
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.file.modelfile import model_hash
from parallel_cal.model.mechanism import Mechanism, poses_in_workspace
from parallel_cal.model.model import Model

PROBLEMS = ("direct", "inverse")
DIRECTION_THRESHOLD = 5e-4  # rad or m, as the parameter of the kinematics node
PATH_AMPLITUDE = 0.005  # of the example's path, as a share of the mechanism's length
MAX_POSES = 300_000  # test vectors; each takes a few kB of memory and 1 kB of the file
SEARCH = {  # words of the templates: limits of the solver and of its search
    "closed": MAX_CLOSED_RESIDUAL_M,
    "limit_rounding": LIMIT_ROUNDING,
    "settled": MAX_SETTLED_STEP_M,
    "singular": MIN_REGULAR_SINGULAR_VALUE,
    "suspect": SUSPECT_PIVOT,
    "threshold": DIRECTION_THRESHOLD,
    "all_steps": 10 * MAX_DESCENT_STEPS + 4 * MAX_PATH_STEPS,
    "descents": MAX_DESCENT_STEPS,
    "slow_steps": SLOW_STEPS,
    "slow_share": MAX_SLOW_SHARE,
    "same_solution": SAME_SOLUTION,
    "path_steps": MAX_PATH_STEPS,
    "path_growth": PATH_GROWTH,
    "first_share": FIRST_SHARE,
    "max_bend": MAX_BEND,
    "least_step": MIN_STEP_FRACTION,
}
HELPERS = {
    "casadi_real": "double",
    "casadi_sq": "square",
    "casadi_sign": "sign",
    "casadi_fabs": "fabs",
    "casadi_fmax": "fmax",
    "casadi_fmin": "fmin",
}
SPLIT_TURNS = (
    "{} controls one coordinate of the orientation and turns about the two others by up to {:.2g} "
    "rad: this code does not restore the controlled one after each solution, as Python does, and "
    "would leave it by some 1e-4 rad. State all three as `controls` of the mechanism"
)
MAX_TURN_RAD = 1e-6  # squared, it is below the rounding of a solution
CHECKED_POSES = 50
MAKEFILE = """# Checks @robot@.c against @robot@_vectors.csv, Python's answers.
CFLAGS = -std=c99 -O2 -Wall -Wextra -Wconversion -Wsign-conversion -Wpedantic -Werror

check: @robot@_check
\t./@robot@_check @robot@_vectors.csv

# Runs the example of a controller's loop.
loop: @robot@_loop
\t./@robot@_loop

@robot@_%: @robot@_%.c @robot@.c @robot@.h
\t$(CC) $(CFLAGS) $< @robot@.c -o $@ -lm
"""


def files(model: Model, name: str = "", poses: int = 1000) -> dict[str, str]:
    """Return C source, header, check, example, build files and `poses` test vectors by name.

    `name` is the prefix of all names in them; the default is the mechanism's name.
    """
    robot = name or re.sub(r"\W", "_", model.mechanism.name.split(".")[-1])
    if not re.fullmatch(r"[A-Za-z]\w*", robot):
        raise ModelError(f"name={robot}: expected a valid C identifier")
    if not 2 <= poses <= MAX_POSES:
        raise ModelError(f"poses={poses}: expected 2 to {MAX_POSES}")
    if splits_turns(m := model.mechanism):
        given = poses_in_workspace(m, CHECKED_POSES, np.random.default_rng(0))
        found = Kinematics(model).inverse(*given)
        turned = rotation_vector(found.rotation[found.solved]) - m.home.rotation_vector
        most = np.abs(turned[:, [i - 3 for i in m.parasitic if i >= 3]]).max(initial=0.0)
        if most > MAX_TURN_RAD:
            raise ModelError(SPLIT_TURNS.format(m.name, most))
    words = template_words(model, robot)
    templates = {
        f"{robot}.h": read_template("robot.h"),
        f"{robot}.c": read_template("robot.c"),
        f"{robot}_check.c": read_template("check.c"),
        f"{robot}_loop.c": read_template("loop.c"),
        "CMakeLists.txt": read_template("library.cmake"),
        "Makefile": MAKEFILE,
    }
    written = {file: fill_template(text, words) for file, text in templates.items()}
    return written | {f"{robot}_vectors.csv": vectors(model, poses)}


def read_template(name: str) -> str:
    return resources(__package__).joinpath("_c", name).read_text(encoding="utf-8")


def fill_template(text: str, words: Mapping[str, str]) -> str:
    return re.sub(r"@(\w+)@", lambda found: words[found[1]], text)


def template_words(model: Model, robot: str) -> dict[str, str]:
    """Return the replacement of each @word@ in the templates."""
    s, m, n = model.structure, model.mechanism, len(model.joints)
    newton = [newton_functions(s, problem) for problem in PROBLEMS]
    unknown = [functions.columns for functions in newton]
    limits = np.array(m.joint_limits, dtype=float).reshape(-1, 2).T
    rates = np.array(m.joint_rates or ((np.inf, np.inf),) * n, dtype=float).T
    home = np.asarray(m.home.configuration)
    words: dict[str, Any] = {
        **SEARCH,
        **_condition_words(model, robot),
        **_passive_words(m),
        "robot": robot,
        "ROBOT": robot.upper(),
        "version": __version__,
        "hash": model_hash(model),
        "what": ", ".join(
            [m.name, *(effect.name for effect in model.effects if not effect.of_device)]
        ),
        "joints": ", ".join(model.joints),
        "joint_table": "\n".join(f" * {line}" for line in _describe_joints(m)),
        "joint_table_cpp": "\n".join(f"// {line}" for line in _describe_joints(m)),
        "units": ", ".join(dict.fromkeys(m.joint_units)),
        "controls": " ".join(m.controls),
        "n_joints": n,
        "rows": s.phi.shape[0],
        "most": max(s.phi.shape[0], *map(len, unknown), n, 6),
        "constants": max(functions.iteration.n_constants for functions in newton),
        "effects": int(bool(model.effects)),
        "home": _list(m.home.configuration),
        "scale": _list(s.scale),
        "low": _list(limits[0]),
        "high": _list(limits[1]),
        "turn": _list(m.joint_periods),
        "velocity": _list(rates[0]),
        "acceleration": _list(rates[1]),
        "name_size": max(map(len, m.joints)) + 1,
        "joint_names": ", ".join(f'"{joint}"' for joint in m.joints),
        "home_joints": _list(home[:n]),
        "home_position": _list(home[n : n + 3]),
        "home_rotation": _list(home[n + 3 : n + 12]),
        "n_passive": len(m.passive),
        "passive_turn": _list([*(2 * np.pi * (unit == "rad") for unit in m.passive_units), 0.0]),
        "motors": int(bool(newton[1].motor_blocks)),
        "length": m.length,
        "short_step": _list(short_step(m)),
        "amplitude": PATH_AMPLITUDE * m.length,
        "generated": _generate_functions(model, newton),
        "given": _lines(_generate_copy(m.controlled)),
    }
    for problem in PROBLEMS:
        words |= _problem_words(model, problem)
    return {key: str(value) for key, value in words.items()}


def _problem_words(model: Model, problem: str) -> dict[str, Any]:
    """Return the replacements of the words that end in `_direct` or `_inverse`."""
    n, split = len(model.joints), Problem(model, problem, compile=False)
    functions = newton_functions(model.structure, problem)
    given = {"direct": [*range(n)], "inverse": [n + i for i in model.mechanism.controlled]}
    u, g = functions.columns, given[problem]
    blocks = [block for block in functions.blocks if block.sign]
    return {
        f"unknown_{problem}": _list(u),
        f"n_{problem}": len(u),
        f"given_{problem}": _list(g),
        f"g_{problem}": len(g),
        f"turns_{problem}": 3 if problem == "direct" else free_turn(model.mechanism),
        f"constants_{problem}": functions.iteration.n_constants,
        f"blocks_{problem}": len(blocks),
        f"block_sizes_{problem}": _list([len(block.rows) for block in blocks] or [0]),
        f"block_signs_{problem}": _list([int(block.sign) for block in blocks] or [0]),
        f"block_rows_{problem}": _list([row for block in blocks for row in block.rows] or [0]),
        f"block_columns_{problem}": _list(
            [column for block in blocks for column in block.columns] or [0]
        ),
        f"at_home_{problem}": int(split.begins_at_home),
        f"path_home_{problem}": _list(split.home),
        f"branches_{problem}": int(split.has_branches),
    }


def _describe_joints(m: Mechanism) -> list[str]:
    """Describe the readings of the joints, and how the angles of motors convert to them."""
    drives = m.drives or (None,) * len(m.joints)
    lines = ["Joints, in this order:"]
    for joint, unit, drive in zip(m.joints, m.joint_units, drives, strict=True):
        words = f"  {joint} [{unit}]"
        if drive is not None:
            words += f" = {drive.travel!r} * angle of the motor [rad], a {drive.kind}"
            size = f"{drive.per_rev!r} m per turn of the motor"
            if drive.per_rev is None:
                size = f"radius {drive.radius!r} m, advantage {drive.advantage!r}"
            words += f" ({size}, gear {drive.gear!r})"
        lines.append(words)
    if any(drives):
        lines += [
            "The angle of a motor is 0 where its joint reads 0. The factor is constant:",
            "what a spool does beyond it is an effect of the model, and in the functions below.",
        ]
    return lines


def _name_member(condition: str) -> str:
    """Return the member of the struct: one for all joints, and `temperature_arms` of a part."""
    kind = condition.split(".")[0]
    return kind if CONDITIONS[kind][2] else condition.replace(".", "_")


def _generate_copy(coordinates: list[int]) -> list[str]:
    """Generate C that copies coordinates of a pose; a rotation is copied as a whole."""
    lines = [f"given[NQ + {i}] = position[{i}];" for i in coordinates if i < 3]
    if any(i >= 3 for i in coordinates):
        lines.append("memcpy(given + NQ + 3, rotation, 9 * sizeof *given);")
    return lines


def _condition_words(model: Model, robot: str) -> dict[str, Any]:
    """Return what the templates say of the conditions, the members of a struct."""
    names = []  # in C: `temperature`, or `direction[0]` of a joint
    for name in model.conditions:
        kind, _, joint = name.partition(".")
        number = f"[{model.joints.index(joint)}]" if CONDITIONS[kind][2] else ""
        names.append(_name_member(name) + number)
    # The specification of each member of the struct: unit, neutral value, whether by joint.
    members = {_name_member(name): CONDITIONS[name.split(".")[0]] for name in model.conditions}
    fields = [
        f"    double {member}{f'[{robot.upper()}_JOINTS]' * by_joint}; /* {unit}, {value:g} */"
        for member, (unit, value, by_joint) in members.items()
    ]
    neutral = [
        f"{{{_list([value] * len(model.joints))}}}" if by_joint else _list([value])
        for _, value, by_joint in members.values()
    ]
    return {
        "n_conditions": len(names),
        "conditions": "\n".join(fields or ["    double none; /* the model needs none */"]),
        "neutral": ", ".join(neutral or ["0.0"]),
        "copied": _lines(f"a[{k}] = at->{c};" for k, c in enumerate(names or ["none"])),
        "read": _lines((f"now.{c} = row[{2 + k}];" for k, c in enumerate(names)), 8),
        "followed": _lines(
            f"memcpy(at->{kind}, motion->{kind}, sizeof at->{kind});"
            for kind, (_, _, by_joint) in members.items()
            if by_joint and kind != "acceleration"  # differences of readings are mostly noise
        ),
    }


def _passive_words(m: Mechanism) -> dict[str, str]:
    """Return what the templates say of passive coordinates; nothing of a robot without any."""
    if not m.passive:
        return dict.fromkeys(("home_passive", "passive_member", "from_passive", "to_passive"), "")
    names = ", ".join(f"{name} [{u}]" for name, u in zip(m.passive, m.passive_units, strict=True))
    return {
        "home_passive": f", {{{_list(m.home.passive)}}}",
        "passive_member": f"    double passive[{len(m.passive)}]; /* {names} */\n",
        "from_passive": "    memcpy(x + NQ + 12, from->passive, NU * sizeof *x);\n",
        "to_passive": "    memcpy(to->passive, x + NQ + 12, NU * sizeof *x);\n",
    }


def _lines(lines: Any, indent: int = 4) -> str:
    return "\n".join(" " * indent + line for line in lines)


def _list(values: Any) -> str:
    infinite = {np.inf: "HUGE_VAL", -np.inf: "MINUS_HUGE_VAL"}
    return ", ".join(infinite.get(v) or repr(v) for v in np.asarray(values).tolist())


# ------------------------------------------------------------------ CasADi's expressions as C


def _generate_functions(model: Model, newton: list[NewtonFunctions]) -> str:
    """Generate the functions that the templates call, with the model's numbers."""
    s = model.structure
    parts = [s.closure_configuration(s.configuration, s.a, ca.DM(model.values))]
    change = ca.SX.sym("change", s.configuration.shape[0])
    rate = ca.jtimes(ca.vec(parts[0][1]), s.configuration, change)
    beyond = ca.substitute(s.beyond, s.v, ca.DM(model.values))
    functions = [
        (dense("closure", [s.configuration, s.a], list(parts[0])), "x a", "phi slopes"),
        (dense("overstretch", [s.configuration, s.a], [beyond]), "x a", "beyond"),
        (dense("closure_rate", [s.configuration, s.a, change], [rate]), "x a change", "slopes"),
    ]
    for problem, of in zip(PROBLEMS, newton, strict=True):
        step, k = of.iteration, Single(of.tables)(model.values)[0]
        before = step.prepare(s.configuration, s.a, ca.DM(k))
        prepare = dense(f"{problem}_prepare", [s.configuration, s.a], [before])
        functions += [
            (prepare, "given a", "before"),
            (_rename_function(step.step, f"{problem}_step"), "x constants", "to length pivot"),
            (_rename_function(step.residual, f"{problem}_residual"), "x constants", "phi"),
        ]
    return "\n".join(_c_function(f, ins.split(), outs.split()) for f, ins, outs in functions)


def _rename_function(function: ca.Function, name: str) -> ca.Function:
    inputs = function.sx_in()
    return ca.Function(name, inputs, function.call(inputs))


def _c_function(function: ca.Function, inputs: list[str], outputs: list[str]) -> str:
    """Return CasADi's C code of a function, with named arrays as arguments."""
    code = ca.CodeGenerator("code.c")
    code.add(function)
    found = re.search(r"static int casadi_f0\(.*?\) \{\n(.*?)  return 0;\n\}", code.dump(), re.S)
    body = found[1] if found else "casadi_"
    for i, name in enumerate(inputs):
        body = re.sub(rf"arg\[{i}\]\? arg\[{i}\]\[(\d+)\] : 0", rf"{name}[\1]", body)
    for i, name in enumerate(outputs):
        body = re.sub(rf"if \(res\[{i}\]!=0\) res\[{i}\]\[(\d+)\]=", rf"{name}[\1]=", body)
    body = re.sub(r"!(a\d+)\b", r"\1==0", body)
    body = re.sub(r"\((a\d+)\?", r"(\1!=0?", body)
    body = re.sub(r"\((a\d+)(&&|\|\|)(a\d+)\)", r"(\1!=0\2\3!=0)", body)
    body = re.sub(r"casadi_\w+", lambda word: HELPERS.get(word[0], word[0]), body)
    if strange := re.search(r"casadi_\w*|\b(arg|res|iw|w)\b", body):
        raise ModelError(
            f"{function.name()}: cannot translate '{strange[0]}' in its expression to C"
        )
    taken = [f"const double *{name}" for name in inputs] + [f"double *{name}" for name in outputs]
    unused = "".join(f"  (void){name};\n" for name in inputs)
    return f"static void {function.name()}({', '.join(taken)})\n{{\n{body}{unused}}}\n"
