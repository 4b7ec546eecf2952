"""PTX text as functions, variables and statements.

Only what a compiler writes is read: one entry or function after another, with declarations, labels, instructions and
nested scopes in it (PTX ISA 9.0, chapters 4, 5 and 7). What is not understood raises :class:`UnknownPtx`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

SIZES = {"pred": 1, "b8": 1, "u8": 1, "s8": 1, "b16": 2, "u16": 2, "s16": 2, "b32": 4, "u32": 4, "s32": 4, "f32": 4,
         "b64": 8, "u64": 8, "s64": 8, "f64": 8}  # fmt: skip


class UnknownPtx(ValueError):
    """An instruction or directive that the translator does not know; it names it."""


@dataclass(frozen=True)
class Variable:
    """A variable of a state space: ``size`` and ``align`` in bytes; ``values`` its initial elements as written."""

    name: str
    space: str
    type: str
    size: int
    align: int
    external: bool = False
    values: tuple[str, ...] = ()


@dataclass
class Statement:
    """``what`` is open, close, label, registers, variable, targets or instruction."""

    what: str
    line: int
    name: str = ""
    text: str = ""
    opcode: str = ""
    operands: tuple[str, ...] = ()
    guard: str = ""
    guard_negated: bool = False
    variable: Variable | None = None


@dataclass
class Function:
    """An entry or a device function; ``results`` are its return parameters."""

    name: str
    entry: bool
    params: list[Variable] = field(default_factory=list)
    results: list[Variable] = field(default_factory=list)
    body: list[Statement] | None = None


@dataclass
class Module:
    """What a PTX file defines."""

    functions: dict[str, Function] = field(default_factory=dict)
    variables: dict[str, Variable] = field(default_factory=dict)


_VARIABLE = re.compile(
    r"^(?P<before>(?:\.(?:extern|visible|weak|common)\s+)*)\.(?P<space>global|const|shared|local|param)\s+"
    r"(?:\.align\s+(?P<align>\d+)\s+)?(?:\.ptr\s*(?:\.\w+\s*)*?(?:\.align\s+\d+\s+)?)?\.(?P<type>[a-z]+\d+|pred)\s+"
    r"(?P<name>[\w$.%]+)\s*(?P<shape>(?:\[\s*\d*\s*\])*)\s*(?:=\s*(?P<values>.*))?$",
    re.DOTALL,
)
_LABEL = re.compile(r"\s*([\w$%]+):(?!:)")
_FUNCTION = re.compile(
    r"^(?:\.(?:extern|visible|weak)\s+)*\.(?P<kind>entry|func)\s*(?:\((?P<results>[^)]*)\))?\s*(?P<name>[\w$]+)\s*"
    r"(?:\((?P<params>[^)]*)\))?(?P<rest>.*)$",
    re.DOTALL,
)
_LINE_DIRECTIVES = re.compile(r"^\s*\.(version|target|address_size)\b[^\n]*$", re.MULTILINE)


def variable(text: str) -> Variable:
    """A declaration such as ``.shared .align 4 .b8 name[128]``, with its initial values."""
    found = _VARIABLE.match(text.strip())
    if found is None:
        raise UnknownPtx(f"PTX declaration {text.strip()[:120]!r} is not understood")
    element = SIZES.get(found["type"])
    if element is None:
        raise UnknownPtx(f"PTX type .{found['type']} of {found['name']} is not known")
    count = 1
    for extent in re.findall(r"\[\s*(\d*)\s*\]", found["shape"]):
        count *= int(extent) if extent else 0
    values: tuple[str, ...] = ()
    if found["values"]:
        inside = found["values"].replace("{", " ").replace("}", " ")
        values = tuple(v.strip() for v in inside.split(",") if v.strip())
    return Variable(
        name=found["name"],
        space=found["space"],
        type=found["type"],
        size=element * count,
        align=int(found["align"] or element),
        external=".extern" in found["before"],
        values=values,
    )


def split(text: str, separator: str = ",") -> list[str]:
    """Parts of ``text`` between separators that are not inside brackets."""
    parts, depth, begin = [], 0, 0
    for i, char in enumerate(text):
        if char in "{[(":
            depth += 1
        elif char in "}])":
            depth -= 1
        elif char == separator and depth == 0:
            parts.append(text[begin:i].strip())
            begin = i + 1
    last = text[begin:].strip()
    return [*parts, last] if last or parts else []


def parse(text: str) -> Module:
    """Read a PTX file.

    Raises:
        UnknownPtx: naming what is not understood.
    """
    text = re.sub(r"/\*.*?\*/", lambda m: "\n" * m[0].count("\n"), text, flags=re.DOTALL).rstrip("\0")
    text = re.sub(r"//[^\n]*", "", text)
    text = _LINE_DIRECTIVES.sub("", text)
    module, position, line = Module(), 0, 1
    function: Function | None = None
    depth = 0
    ends = re.compile(r"[;{}]")
    while True:
        blank = re.compile(r"\s*").match(text, position)
        line += text.count("\n", position, blank.end())
        position = blank.end()
        if position >= len(text):
            return module
        label = _LABEL.match(text, position) if depth else None
        if label is not None:
            following = text[label.end() : label.end() + 80].lstrip()
            if following.startswith((".branchtargets", ".calltargets", ".callprototype")):
                stop = text.index(";", position)
                statement = text[label.end() : stop].strip()
                directive, _, rest = statement.partition(" ")
                if directive != ".branchtargets":
                    raise UnknownPtx(
                        f"PTX directive {directive} (line {line}) is not known: no indirect calls"
                    )
                function.body.append(Statement("targets", line, label[1], operands=tuple(split(rest))))
                line += text.count("\n", position, stop + 1)
                position = stop + 1
                continue
            function.body.append(Statement("label", line, label[1]))
            position = label.end()
            continue
        end = ends.search(text, position)
        if end is None:
            raise UnknownPtx(f"PTX line {line}: {text[position : position + 80]!r} does not end")
        head = text[position : end.start()].strip()
        if end[0] == "{" and not head:
            depth += 1
            if depth > 1:
                function.body.append(Statement("open", line))
            position = end.end()
            continue
        if end[0] == "}" and not head:
            depth -= 1
            if depth:
                function.body.append(Statement("close", line))
            position = end.end()
            continue
        if end[0] == "{" and depth == 0 and (".entry" in head or ".func" in head):
            function = _function(head)
            function.body = []
            module.functions[function.name] = function
            depth = 1
            line += text.count("\n", position, end.end())
            position = end.end()
            continue
        stop = text.find(";", position)  # braces inside a statement are operands or initial values
        if stop < 0:
            raise UnknownPtx(f"PTX line {line}: {text[position : position + 80]!r} does not end")
        statement = text[position:stop].strip()
        if depth == 0:
            _declare(module, statement, line)
        else:
            function.body.append(_statement(statement, line))
        line += text.count("\n", position, stop + 1)
        position = stop + 1


def _function(head: str) -> Function:
    found = _FUNCTION.match(head)
    if found is None:
        raise UnknownPtx(f"PTX function {head[:120]!r} is not understood")
    rest = re.sub(
        r"\.(maxntid|reqntid|minnctapersm|maxnreg|maxnctapersm|pragma)\b[^.]*|\.noreturn", "", found["rest"]
    )
    if rest.strip():
        raise UnknownPtx(f"PTX function {found['name']}: {rest.strip()!r} is not known")
    return Function(
        name=found["name"],
        entry=found["kind"] == "entry",
        params=[variable(p) for p in split(found["params"] or "")],
        results=[variable(p) for p in split(found["results"] or "")],
    )


def _declare(module: Module, statement: str, line: int) -> None:
    if ".func" in statement or ".entry" in statement:
        function = _function(statement)
        module.functions.setdefault(function.name, function)
    elif statement.startswith((".file", ".pragma", ".alias")):
        if statement.startswith(".alias"):
            raise UnknownPtx(f"PTX line {line}: {statement[:80]!r} is not known")
    else:
        found = variable(statement)
        module.variables[found.name] = found


def _statement(text: str, line: int) -> Statement:
    if text.startswith(".reg"):
        return Statement("registers", line, text=text)
    if re.match(r"\.(pragma|loc|maxnreg|maxntid|reqntid|minnctapersm)\b", text):
        return Statement("nothing", line)
    if text.startswith("."):
        return Statement("variable", line, variable=variable(text))
    guard, negated = "", False
    if text.startswith("@"):
        mark, guard, text = re.match(r"@(!?)\s*([\w%$]+)\s+(.*)$", text, re.DOTALL).groups()
        negated = mark == "!"
    opcode, rest = re.match(r"([\w.:]+)\s*(.*)$", text, re.DOTALL).groups()
    return Statement(
        "instruction",
        line,
        text=text,
        opcode=opcode,
        operands=tuple(split(rest)),
        guard=guard,
        guard_negated=negated,
    )
