"""PTX kernels as C++ for ``machine.h``: one function for an entry, one for each device function that it calls.

An entry without barriers, shuffles and votes keeps its registers in local variables. One that has them keeps a
thread's registers in memory, and returns to the scheduler at each such instruction, to be entered there again.
Approximate instructions (``ex2.approx``, ``lg2.approx``, ``sin.approx``, ...) are computed by the C library, so that
they are closer to the truth than a GPU's; everything else is rounded as PTX ISA 9.0 says.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from ptx.arithmetic import Arithmetic
from ptx.effects import Effects
from ptx.operands import C_TYPES, SPACES, WAITING, c_name, immediate
from ptx.parse import SIZES, Function, Module, Statement, UnknownPtx, Variable, split


@dataclass
class Program:
    """A translated entry: C++ source, sizes of its parameters, bytes of static shared memory, whether it has dynamic
    shared memory besides, the instruction at each site, and what each basic block executes."""

    source: str
    params: list[int]
    shared_bytes: int
    dynamic_shared: bool
    cooperative: bool
    sites: list[str]
    tallies: list[dict[str, int]]


def translate(module: Module, entry: str, count: bool = False) -> Program:
    """C++ of one entry of a module; ``count`` adds a counter to every basic block.

    Raises:
        UnknownPtx: naming an instruction, directive or symbol that is not known.
    """
    if entry not in module.functions or not module.functions[entry].entry:
        known = ", ".join(f.name for f in module.functions.values() if f.entry)
        raise UnknownPtx(f"entry: got {entry!r}, expected one of {known}")
    shared = _Shared()
    whole = _Whole(module, shared, count)
    whole.require(entry)
    main = module.functions[entry]
    globals_ = "\n".join(whole.definitions)
    declarations = "\n".join(f"static {whole.signature(f)};" for f in whole.code if f != entry)
    functions = "\n".join(code for name, code in whole.code.items() if name != entry)
    run = "run_block(C);" if whole.cooperative else _EACH_THREAD
    whole_bytes = -(-shared.bytes // 128) * 128 if shared.dynamic else shared.bytes
    source = f"""#include "machine.h"
#define DYNAMIC_SHARED {whole_bytes}u
{globals_}
{declarations}
{functions}
{whole.code[entry]}
extern "C" u64 ptx_registers() {{ return sizeof(Registers); }}
extern "C" void ptx_run(Context* C)
{{
    alignas(16) char jump[1024];
    C->jump = jump;
    if (_setjmp(jump)) return;
    for (u64 k = 0; k < C->blocks; ++k) {{
        C->block = C->block_order[k];
        __builtin_memset(C->shared, 0xff, C->shared_bytes);
        {run}
    }}
}}
"""
    return Program(
        source=source,
        params=[p.size for p in main.params],
        shared_bytes=whole_bytes,
        dynamic_shared=shared.dynamic,
        cooperative=whole.cooperative,
        sites=whole.sites,
        tallies=whole.tallies,
    )


_EACH_THREAD = """for (u32 w = 0, warps = (C->block_dim + 31) / 32; w < warps; ++w)
            for (u32 i = 0; i < 32; ++i) {
                const u32 t = 32 * C->warp_order[w] + C->lane_order[i];
                if (t >= C->block_dim) continue;
                C->thread = t;
                run_thread(C, t);
            }"""


@dataclass
class _Shared:
    """Places of shared variables in the block's buffer."""

    bytes: int = 0
    dynamic: bool = False
    places: dict[str, int] = field(default_factory=dict)
    external: list[str] = field(default_factory=list)

    def place(self, v: Variable, owner: str) -> str:
        if v.external or v.size == 0:
            self.dynamic = True
            return "DYNAMIC_SHARED"
        key = f"{owner}/{v.name}"
        if key not in self.places:
            self.bytes = -(-self.bytes // v.align) * v.align
            self.places[key] = self.bytes
            self.bytes += v.size
        return f"{self.places[key]}u"


class _Whole:
    """What the functions of a program share."""

    def __init__(self, module: Module, shared: _Shared, count: bool) -> None:
        self.module, self.shared, self.count = module, shared, count
        self.code: dict[str, str] = {}
        self.definitions: list[str] = []
        self.defined: dict[str, str] = {}
        self.sites: list[str] = []
        self.tallies: list[dict[str, int]] = []
        self.cooperative = False

    def require(self, name: str) -> None:
        """Translate the function, if that was not done."""
        if name in self.code:
            return
        function = self.module.functions.get(name)
        if function is None or function.body is None:
            raise UnknownPtx(f"PTX calls {name}, which has no body")
        self.code[name] = ""
        self.code[name] = _Translator(self, function).translate()

    def signature(self, name: str) -> str:
        f = self.module.functions[name]
        params = "".join(f", u64 {c_name(p.name)}" for p in [*f.results, *f.params])
        return f"void {c_name(name)}(Context* C, const u32 t{params})"

    def site(self, s: Statement) -> int:
        self.sites.append(f"PTX line {s.line}: {' '.join(s.text.split())}")
        return len(self.sites) - 1

    def symbol(self, name: str) -> str | None:
        """C++ expression of the address of a variable of the module, defined when it is first met."""
        v = self.module.variables.get(name)
        if v is None:
            return None
        if v.space == "shared":
            return self.shared.place(v, "")
        if name not in self.defined:
            c = c_name(name)
            self.defined[name] = f"(u64){c}"
            if v.external:
                raise UnknownPtx(f"PTX variable {name} is external")
            element = C_TYPES[v.type]
            values = [self._initial(x, v.type) for x in v.values]
            count = max(v.size // SIZES[v.type], 1)
            self.definitions.append(
                f"alignas({max(v.align, 16)}) static {element} {c}[{count}] = {{{', '.join(values)}}};"
            )
        return self.defined[name]

    def _initial(self, text: str, type_: str) -> str:
        if re.match(r"^[-+]?\d|^0[fFdD]", text):
            return immediate(text, type_)
        raise UnknownPtx(f"PTX initial value {text!r} is not known")


class _Translator(Arithmetic, Effects):
    """One function."""

    def __init__(self, whole: _Whole, function: Function) -> None:
        super().__init__(whole, function)
        self.local_bytes = 0
        self.tally: dict[str, int] | None = None
        body = function.body or []
        self.waits = any(
            s.what == "instruction" and s.opcode.split(".")[0] in WAITING and s.opcode != "bar.arrive"
            for s in body
        )
        if self.waits and not function.entry:
            raise UnknownPtx(f"PTX function {function.name} waits for other threads outside of an entry")
        if function.entry:
            whole.cooperative = self.waits

    # Statements

    def translate(self) -> str:
        f = self.function
        self.push()
        for i, p in enumerate(f.params):
            self.symbols[0][p.name] = f"(u64)C->params[{i}]" if f.entry else c_name(p.name)
        for p in f.results:
            self.symbols[0][p.name] = c_name(p.name)
        self.block()
        for s in f.body or []:
            if s.what == "targets":
                self.targets[s.name] = s.operands
        for s in f.body or []:
            self.statement(s)
        body = "\n".join(self.lines)
        name = "Registers" if f.entry else f"Registers_{c_name(f.name)}"
        fields = "".join(f" {t} {c};" for c, t in self.registers.items())
        depot = f" alignas(16) char local[{self.local_bytes}];" if self.local_bytes else ""
        struct = f"struct {name} {{ u32 resume; bool carry;{fields} }};"
        local = f"struct {name}_local {{{depot} }};"
        if not f.entry:
            head = f"static {self.whole.signature(f.name)}\n{{\n{name} R = {{}};\n{name}_local L;\n"
            return f"{struct}\n{local}\n{head}{body}\n}}"
        run = "static __attribute__((noinline)) void run_thread(Context* C, u32 t)\n{\nThread& T = C->threads[t];\n"
        if not self.waits:
            return f"{struct}\n{local}\n{run}{name} R = {{}};\n{name}_local L;\n{body}\n}}"
        cases = "".join(f"case {k}: goto resume_{k}; " for k in range(1, self.resumes + 1))
        struct = f"{local}\n" + struct.replace(" }", f" {name}_local local; }}", 1)
        restart = "__builtin_memset(&R, 0, sizeof(R)); __builtin_memset(&R.local, 0xff, sizeof(R.local));"
        return (
            f"{struct}\n{run}{name}* __restrict registers = ({name}*)C->registers + t;\n{name}& R = *registers;\n"
            f"{name}_local& L = R.local;\nswitch (R.resume) {{ case 0: {restart} break; {cases}}}\n{body}\n}}"
        )

    def block(self) -> None:
        """Begin a basic block: with counters, one of its own."""
        if not self.whole.count:
            return
        self.tally = {}
        self.whole.tallies.append(self.tally)
        self.lines.append(f"++C->counts[{len(self.whole.tallies) - 1}];")

    def done(self) -> str:
        finish = "R.resume = 0; T.state = FINISHED; " if self.waits else ""
        return f"{{ {finish}return; }}"

    def statement(self, s: Statement) -> None:
        if s.what == "open":
            self.push()
            self.lines.append("{")
        elif s.what == "close":
            self.pop()
            self.lines.append("}")
        elif s.what == "label":
            self.seen_labels.add(s.name)
            self.lines.append(f"{c_name(s.name)}: ;")
            self.block()
        elif s.what == "registers":
            type_, *names = re.match(r"\.reg\s+\.(\w+)\s+(.*)$", s.text, re.DOTALL).groups()
            if type_ not in C_TYPES:
                raise UnknownPtx(f"PTX line {s.line}: register type .{type_} is not known")
            for name in split(names[0]):
                many = re.match(r"^(.*)<(\d+)>$", name)
                if many:
                    self.scopes[-1][many[1]] = (type_, int(many[2]))
                else:
                    self.scopes[-1][name] = (type_, None)
        elif s.what == "variable":
            self.variable(s.variable)
        elif s.what == "instruction":
            self.instruction(s)

    def variable(self, v: Variable) -> None:
        if v.space == "shared":
            self.symbols[-1][v.name] = self.whole.shared.place(v, self.function.name)
        elif v.space == "local":
            self.local_bytes = -(-self.local_bytes // v.align) * v.align
            self.symbols[-1][v.name] = f"((u64)L.local + {self.local_bytes}u)"
            self.local_bytes += v.size
        elif v.space == "param":
            c = f"{c_name(v.name)}_{self.scope_names[-1]}"
            self.lines.append(f"alignas(16) char {c}[{max(v.size, 1)}];")
            self.symbols[-1][v.name] = c
        else:
            raise UnknownPtx(f"PTX variable {v.name} in .{v.space} inside a function is not known")

    def instruction(self, s: Statement) -> None:
        base, *mods = s.opcode.split(".")
        mods = re.sub(r"\.(L1|L2)::\w+", "", s.opcode).split(".")[1:]
        handler: Callable[..., list[str]] | None = getattr(self, f"op_{base}", None)
        if handler is None:
            raise UnknownPtx(f"PTX instruction {s.opcode} (line {s.line}: {s.text!r}) is not known")
        try:
            code = handler(s, mods, s.operands)
        except UnknownPtx as error:
            raise UnknownPtx(f"line {s.line}, {s.text!r}: {error}") from error
        except (IndexError, ValueError, KeyError) as error:
            raise UnknownPtx(
                f"PTX instruction {s.opcode} (line {s.line}: {s.text!r}) is not understood"
            ) from error
        if s.guard:
            guard = self.read(s.guard, "pred")
            self.lines.append(f"if ({'!' if s.guard_negated else ''}{guard}) {{")
            self.lines += code
            self.lines.append("}")
        else:
            self.lines += code
        if self.tally is not None:
            for key, n in _classes(base, mods).items():
                self.tally[key] = self.tally.get(key, 0) + n
            if base in ("bra", "brx", "call", "ret", "exit") or base in WAITING:
                self.block()


def _classes(base: str, mods: list[str]) -> dict[str, int]:
    """What an instruction counts as."""
    types = [m for m in mods if m in SIZES]
    if base in ("ld", "ldu", "st", "atom", "red"):
        count = next((int(m[1:]) for m in mods if m in ("v2", "v4", "v8")), 1)
        space = next((m for m in mods if m in SPACES), "generic")
        if space == "param":
            return {}
        verb = {"ld": "loads", "ldu": "loads", "st": "stores"}.get(base, "atomics")
        return {f"{space}_{verb}": 1, f"{space}_{verb}_bytes": count * SIZES[types[0]]}
    if base in ("ex2", "lg2", "sin", "cos", "tanh", "rsqrt", "rcp", "sqrt", "div") and types[0][0] == "f":
        return {"special": 1}
    if base in ("shfl", "match", "redux"):
        return {"shuffles": 1}
    if base in ("vote", "activemask"):
        return {"votes": 1}
    if base in ("bar", "barrier"):
        return {"warp_barriers" if "warp" in mods else "barriers": 1}
    if base in ("bra", "brx", "call", "ret", "exit"):
        return {"branches": 1}
    if base == "cvt":
        return {"conversions": 1}
    if base in ("mov", "cvta", "selp"):
        return {"moves": 1}
    if types and types[-1] in ("f32", "f64"):
        return {"fp32" if types[-1] == "f32" else "fp64": 1}
    return {"integer": 1}
