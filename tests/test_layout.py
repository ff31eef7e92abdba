"""The architecture as the README states it: imports go one way, and the core knows no study."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from hapticbridge.kernel.codes import Scheme

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "hapticbridge"

ORDER = (
    ("errors", "lazy", "signals", "units"),
    ("arguments", "confinement", "files"),
    ("clock", "coupling", "dataclass_json", "plotting", "sweep"),
    ("kernel",),
    ("program", "recording", "scene", "theory"),
    ("device",),
    ("demand", "testing"),
    ("realtime",),
    ("identify", "run"),
    ("audit", "check"),
    ("replay", "report"),
    ("lab", "tools", "view"),
    ("whatif",),
    ("cli",),
)
"""Modules and packages directly below hapticbridge. Each imports only from its row and above."""

RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}

FILES = [path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE or path.stem[0] != "_"]


def concept(path: Path) -> str:
    """Returns the module or package directly below hapticbridge that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_modules(path: Path) -> set[str]:
    """Returns the modules of hapticbridge that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = {node.module or "" for node in nodes}
    return {name for name in names if name.startswith("hapticbridge.")}


def imported_concepts(path: Path) -> set[str]:
    return {module.split(".")[1] for module in imported_modules(path)} - {concept(path)}


def test_every_concept_has_a_place_in_the_order() -> None:
    assert {concept(path) for path in FILES} == set(RANK)


def test_imports_go_one_way() -> None:
    offences = [
        f"{path.relative_to(PACKAGE)} imports {other}"
        for path in FILES
        for other in sorted(imported_concepts(path))
        if RANK[other] > RANK[concept(path)]
    ]
    assert not offences


def test_concepts_do_not_import_each_other_in_a_circle() -> None:
    edges: dict[str, set[str]] = {}
    for path in FILES:
        edges.setdefault(concept(path), set()).update(imported_concepts(path))

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " imports ".join((*trail, name))
        for other in edges[name]:
            visit(other, (*trail, name))

    for name in edges:
        visit(name, ())


def test_the_audit_never_imports_the_bridge() -> None:
    loop = {f"hapticbridge.run.{name}" for name in ("bridge", "session", "options")}
    for path in (PACKAGE / "audit").glob("*.py"):
        assert not loop & imported_modules(path), path.name
    for name in (
        "motion",
        "spring",
        "wrench_limits",
        "energy",
    ):  # a second opinion has an arithmetic of its own
        modules = imported_modules(PACKAGE / "audit" / f"{name}.py")
        others = {module for module in modules if not module.startswith("hapticbridge.audit")}
        assert others <= {"hapticbridge.kernel.parameters", "hapticbridge.kernel.record"}, name


def test_the_core_never_imports_the_lab() -> None:
    offences = [
        str(path.relative_to(PACKAGE))
        for path in FILES
        if concept(path) not in {"lab", "cli"} and "lab" in imported_concepts(path)
    ]
    assert not offences


def test_a_run_imports_no_check() -> None:
    for path in [*(PACKAGE / "run").glob("*.py"), PACKAGE / "cli" / "run.py"]:
        assert "check" not in imported_concepts(path), path.name


def test_a_package_names_modules_that_exist() -> None:
    offences = []
    for init in PACKAGE.rglob("__init__.py"):
        if init.parent.name in {"hapticbridge", "engines"}:  # engines has a table of engines
            continue
        guide = ast.get_docstring(ast.parse(init.read_text(encoding="utf-8")))
        assert guide, f"{init.parent.name} has no docstring"
        for name in re.findall(r"``([a-z_.0-9]+)``", guide):
            place = init.parent.joinpath(*name.split("."))
            if not (place.is_dir() or place.with_suffix(".py").is_file()):
                offences.append(f"{init.parent.name} names {name}")
    assert not offences


def private_names(source: str) -> list[str]:
    """Returns the private names that a test reads, of other objects than its own."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and re.match("_[^_]", node.attr):
            owner = ast.unparse(node.value)
            if owner not in {"self", "cls", "super()"} and node.attr not in PUBLIC:
                found.append(f"{owner}.{node.attr}")
        elif isinstance(node, ast.ImportFrom) and "hapticbridge" in (node.module or ""):
            found += [each.name for each in node.names if each.name.startswith("_")]
    return found


PUBLIC = {"_exit", "_replace", "_asdict", "_fields", "_fields_", "_make", "_obj"}
"""Names of the standard library that are public although they begin with an underscore; ``_obj`` is
what a ``byref`` of ctypes points to."""


def test_no_test_reads_a_private_name() -> None:
    examples = "device._link.close()\nfrom hapticbridge.kernel.jit import _cache"
    assert set(private_names(examples)) == {"device._link", "_cache"}
    offences = [
        f"{path.name}: {name}"
        for path in TESTS.rglob("*.py")
        for name in private_names(path.read_text(encoding="utf-8"))
    ]
    assert not offences


def code_lines(source: str) -> int:
    """Returns the count of lines of a module without blank lines, comments and docstrings."""
    lines = {
        number
        for number, line in enumerate(source.splitlines(), 1)
        if line.strip() and not line.strip().startswith("#")
    }
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def test_a_small_module_has_several_importers() -> None:
    """A module with little code belongs to its caller, unless three modules need it."""
    importers: dict[str, set[Path]] = {}
    for path in FILES:
        for module in imported_modules(path):
            importers.setdefault(module, set()).add(path)
    offences = []
    for path in FILES:
        if path.name == "__init__.py" or concept(path) in {"cli", "lab"}:
            continue
        lines = code_lines(path.read_text(encoding="utf-8"))
        name = ".".join(("hapticbridge", *path.relative_to(PACKAGE).with_suffix("").parts))
        users = len(importers.get(name, ()))
        if lines < SMALL and users < 3 and name not in INTERFACES:
            offences.append(f"{name}: {lines} lines, {users} importers")
    assert not offences


SMALL = 80
"""Lines of code of a small module. A smaller one is not worth looking up."""

INTERFACES = {
    "hapticbridge.audit.spring",  # second computation, apart from all that it checks
    "hapticbridge.program.messages",  # between two processes
    "hapticbridge.program.gymnasium",  # imported by users' programs
    "hapticbridge.program.poses",  # for interfaces to other programs, too
    "hapticbridge.program.robosuite",  # imported by users' programs
    "hapticbridge.program.ros_topics",  # imported by users' programs
    "hapticbridge.lazy",  # imported by package files, which are not counted
    "hapticbridge.device.transport.maker_library",  # libraries of makers, for any driver
    "hapticbridge.run.programs",  # run by scripts/setup and the builder of wheels too
    "hapticbridge.kernel.whole_program",  # imported when something is compiled, with numba
}
"""Modules that are small on purpose."""


WRITERS = {
    "mj": "state",
    "run": "state",
    "coupling": "law",
    "level": "force_level",
    "pose": "handle",
    "loop": "tick",
    "energy": "ledger",
    "elastic": "elastic",
    "guard": "tick_guard",
    "watch": "swing_watch",
    "observer": "passivity_controller",
    "lossless": "lossless",
    "springs": "springs",
    "contact": "rigid_contact",
    "shown": "shown_tool",
    "timing": "timing",
    "impact": "impact_pulse",
}
"""Sub-records of the kernel's state, and the module of the kernel that writes each."""


def part_of(node: ast.expr, parts: dict[str, str]) -> str | None:
    """Returns the sub-record that an expression belongs to: ``s.energy.slack``, ``energy["x"]``."""
    found = None
    while isinstance(node, ast.Attribute | ast.Subscript):
        name = node.attr if isinstance(node, ast.Attribute) else ast.unparse(node.slice).strip("'")
        found = name if name in WRITERS else found
        node = node.value
    return parts.get(node.id, found) if isinstance(node, ast.Name) else None


def flat(targets: list[ast.expr]) -> Iterator[ast.expr]:
    for target in targets:
        yield from target.elts if isinstance(target, ast.Tuple) else [target]


def written_parts(source: str) -> set[str]:
    """Returns the sub-records that a module writes to, directly or by a local name."""
    written = set()
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        arguments = [a.arg for a in function.args.args if ast.unparse(a.annotation or a) == "Part"]
        parts = {name: name for name in arguments}
        for node in ast.walk(function):
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name | ast.Tuple):
                values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
                for name, value in zip(flat(node.targets), values, strict=False):
                    part = part_of(value, parts)
                    if isinstance(name, ast.Name) and part is not None:
                        parts[name.id] = part
        for node in ast.walk(function):
            targets: list[ast.expr] = []
            if isinstance(node, ast.Assign):
                targets = list(flat(node.targets))
            elif isinstance(node, ast.AugAssign):
                targets = [node.target]
            elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith("store_"):
                written.add(part_of(node.args[0], parts))
            written |= {part_of(t, parts) for t in targets if not isinstance(t, ast.Name)}
    return {part for part in written if part is not None}


def test_each_part_of_the_kernels_state_has_one_writer() -> None:
    writers: dict[str, set[str]] = {}
    for path in (PACKAGE / "kernel").glob("*.py"):
        for part in written_parts(path.read_text(encoding="utf-8")):
            writers.setdefault(part, set()).add(path.stem)
    assert writers == {part: {module} for part, module in WRITERS.items()}


BRANCHES = (
    {"tick": "before_step", "compared_methods": "drive_compared"},
    {"tick": "_evaluate", "compared_methods": "compared_wrench"},
)
"""Functions of the kernel that together have a branch for each scheme, by module."""


def named_schemes(source: str, function: str) -> set[str]:
    """Returns the schemes that a function compares with ``==``."""
    tree = ast.parse(source)
    body = next(n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function)
    compared = [n.comparators[0] for n in ast.walk(body) if isinstance(n, ast.Compare)]
    return {
        n.attr
        for n in compared
        if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "Scheme"
    }


@pytest.mark.parametrize("functions", BRANCHES, ids=lambda functions: functions["tick"])
def test_each_scheme_has_a_branch_before_and_after_the_step(functions: dict[str, str]) -> None:
    found: set[str] = set()
    for module, function in functions.items():
        source = (PACKAGE / "kernel" / f"{module}.py").read_text(encoding="utf-8")
        found |= named_schemes(source, function)
    assert found == set(Scheme.__members__)


@pytest.mark.parametrize(
    "line",
    [
        "s.energy.slack = 0.0",
        "s.energy.slack += 1.0",
        "force, s.energy.slack = 0.0, 0.0",
        "s.energy.works[2] = 0.0",
        's["energy"]["slack"] = 0.0',
        "store_vector(s.energy.works[0:3], v)",
        "e = s.energy; e.slack = 0.0",
        "works = s.energy.works; works[0] = 0.0",
        "m, e = s.mj, s.energy; e.works[0] += 1.0",
    ],
)
def test_a_write_to_a_part_of_the_state_is_found(line: str) -> None:
    assert written_parts(f"def f(s: State) -> None:\n    {line}") == {"energy"}
    assert written_parts("def f(energy: Part) -> None:\n    energy.slack = 0.0") == {"energy"}
    assert not written_parts(
        "def f(s: State) -> None:\n    slack = s.energy.slack\n    slack = 1.0"
    )


MESSAGES = re.compile(
    "reason|sentence|words|message|remark|cause|clause|fault|concern|remed|problem|hint|finding"
    "|agreement|resimulation|silence|alarm|slowness|change|warned|problem"
)
"""Names of texts for readers: a name or attribute that holds one has one of these in it."""

READING = {"startswith", "endswith", "partition", "rpartition", "split", "rsplit", "find", "index"}
READING |= {"removeprefix", "removesuffix", "count"}
"""Methods by which a program reads a text."""

KEYS = {"name", "word", "event"}
"""Variables of loops that hold a key, a part of a command or a record, and no text for readers."""


def name_of_text(node: ast.expr) -> str:
    """Returns the name behind an expression: ``x.reason[0]``, ``str(reason)``, ``e["reason"]``."""
    if isinstance(node, ast.Call):
        inner = node.args or [node.func]
        is_text = isinstance(node.func, ast.Name) and node.func.id == "str"
        is_get = isinstance(node.func, ast.Attribute) and node.func.attr == "get"
        return name_of_text(inner[0]) if is_text or is_get else ""
    if isinstance(node, ast.Subscript):
        return name_of_text(node.slice) if is_string(node.slice) else name_of_text(node.value)
    if isinstance(node, ast.JoinedStr):
        values = (each.value for each in node.values if isinstance(each, ast.FormattedValue))
        return " ".join(map(name_of_text, values))
    if is_string(node):
        return str(node.value)  # type: ignore[attr-defined] # by the line above
    name = getattr(node, "attr", getattr(node, "id", ""))
    return "" if name.isupper() else name


def is_string(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def read_messages(source: str) -> list[str]:
    """Returns the expressions that take a text for readers apart, or compare it with another.

    ``split()`` without an argument removes line breaks alone. A text that is all in capitals, and
    one in a set of names, is a code. A variable of a loop is a text if it runs over texts.
    """
    found: list[ast.expr] = []
    tree = ast.parse(source)
    loops = [node for node in ast.walk(tree) if isinstance(node, ast.For | ast.comprehension)]
    sources: dict[str, list[str]] = {}
    for loop in loops:
        if isinstance(loop.target, ast.Name) and loop.target.id not in KEYS:
            sources.setdefault(loop.target.id, []).append(name_of_text(loop.iter))

    def is_text(node: ast.expr) -> bool:
        name = name_of_text(node)
        return any(map(MESSAGES.search, (name, *sources.get(name, ()))))

    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner = node.func.value
            if node.func.attr in READING and node.args and not is_string(owner):
                found += [node] if is_text(owner) else []
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            for operator, left, right in zip(node.ops, sides, sides[1:], strict=False):
                is_equal = isinstance(operator, ast.Eq | ast.NotEq)
                is_within = isinstance(operator, ast.In | ast.NotIn)
                texts = [left, right] if is_equal and (is_string(left) or is_string(right)) else []
                texts += [right] if is_within and (is_string(left) or is_code(left)) else []
                is_made = is_equal and (is_sentence_of(left) or is_sentence_of(right))
                texts = [each for each in texts if not is_string(each)]
                found += [node] if is_made or any(map(is_text, texts)) else []
    return [ast.unparse(node) for node in found]


def is_sentence_of(node: ast.expr) -> bool:
    """Returns True for a call of a function whose name says that it returns a text for readers."""
    function = node.func if isinstance(node, ast.Call) else node
    return function is not node and bool(MESSAGES.search(name_of_text(function)))


def is_code(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id.isupper()


@pytest.mark.parametrize(
    "line",
    [
        'report.reason.partition("; ")',
        'report.reason.partition("; ")[0]',
        'str(stop.get("reason")).startswith("SafetyTrip")',
        "reason.endswith(_REASONS[code])",
        "UNKNOWN in self.watch_words",
        '": K = " in f": {sentence}"',
        'report.resimulation == "bit for bit"',
        'event["reason"].split(": ")',
        'concerns[0].rpartition("; write ")',
        '[str(change).partition(" (")[0] for change in changes]',
        "for each in scene.changes:\n    each.startswith(KINDS)",
        "[text.removeprefix(path) for text in messages]",
        "self.problem == permission_problem(self.path)",
    ],
)
def test_a_sentence_that_is_read_back_is_found(line: str) -> None:
    assert read_messages(line)


def test_a_code_is_no_sentence() -> None:
    for line in ('" ".join(words.split())', "code in reasons", 'mode == "r"', "REASON in found"):
        assert not read_messages(line), line


def test_no_part_of_the_core_reads_a_sentence_back() -> None:
    offences = [
        f"{path.relative_to(PACKAGE)}: {text}"
        for path in FILES
        if concept(path) != "lab"
        for text in read_messages(path.read_text(encoding="utf-8"))
    ]
    assert not offences
