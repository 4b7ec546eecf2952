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

from ptx.parse import SIZES, Function, Module, Statement, UnknownPtx, Variable, split

C_TYPES = {"pred": "bool", "f32": "f32", "f64": "f64"} | {
    f"{kind}{bits}": f"{'s' if kind == 's' else 'u'}{bits}" for kind in "bus" for bits in (8, 16, 32, 64)
}
ROUNDINGS = {"rn": "NEAREST", "rz": "ZERO", "rm": "DOWN", "rp": "UP"}
WHOLE = {"rni": "NEAREST", "rzi": "ZERO", "rmi": "DOWN", "rpi": "UP"}
SCOPES = {"cta", "cluster", "gpu", "sys"}
ORDERS = {"volatile", "relaxed", "acquire", "release", "acq_rel", "weak", "sc"}
CACHES = {"ca", "cg", "cs", "cv", "lu", "wb", "wt", "nc"}
SPACES = {"global", "shared", "local", "const", "param"}
COMPARISONS = {
    "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "lo": "<", "ls": "<=", "hi": ">", "hs": ">=",
}  # fmt: skip
SPECIAL = {
    "%tid.x": "t", "%tid.y": "0u", "%tid.z": "0u", "%ntid.x": "C->block_dim", "%ntid.y": "1u", "%ntid.z": "1u",
    "%ctaid.x": "(u32)C->block", "%ctaid.y": "0u", "%ctaid.z": "0u", "%nctaid.x": "(u32)C->blocks", "%nctaid.y": "1u",
    "%nctaid.z": "1u", "%laneid": "(t & 31u)", "%warpid": "(t >> 5)", "WARP_SZ": "32u",
    "%lanemask_eq": "(1u << (t & 31u))", "%lanemask_lt": "((1u << (t & 31u)) - 1u)",
    "%lanemask_le": "((2u << (t & 31u)) - 1u)", "%lanemask_gt": "~((2u << (t & 31u)) - 1u)",
    "%lanemask_ge": "~((1u << (t & 31u)) - 1u)",
}  # fmt: skip
WAITING = ("bar", "barrier", "shfl", "vote", "match", "redux", "activemask")
HOST_FUNCTIONS = ("vprintf", "__assertfail")


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


def _c_name(name: str) -> str:
    return "v_" + re.sub(r"\W", "_", name.replace("%", "").replace("$", "S_").replace(".", "_"))


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
        params = "".join(f", u64 {_c_name(p.name)}" for p in [*f.results, *f.params])
        return f"void {_c_name(name)}(Context* C, const u32 t{params})"

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
            c = _c_name(name)
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
            return _immediate(text, type_)
        raise UnknownPtx(f"PTX initial value {text!r} is not known")


def _immediate(text: str, type_: str) -> str:
    """C++ of a constant operand read as ``type_``."""
    low = text.lower()
    c_type = C_TYPES[type_]
    if low.startswith("0f"):
        value = f"__builtin_bit_cast(f32, 0x{text[2:]}u)"
        return value if c_type == "f32" else f"rd<{c_type}>({value})"
    if low.startswith("0d"):
        value = f"__builtin_bit_cast(f64, 0x{text[2:]}ull)"
        return value if c_type == "f64" else f"rd<{c_type}>({value})"
    found = re.match(r"^([-+~]?)(0x[0-9a-f]+|0b[01]+|0[0-7]*|[1-9]\d*)u?$", low)
    if found is None:
        raise UnknownPtx(f"PTX constant {text!r} is not understood")
    digits = found[2]
    number = int(digits, 8) if re.match(r"^0[0-7]+$", digits) else int(digits, 0)
    number = -number if found[1] == "-" else ~number if found[1] == "~" else number
    if type_ == "pred":
        return "true" if number else "false"
    if c_type in ("f32", "f64"):
        raise UnknownPtx(f"PTX constant {text!r} is read as .{type_}")
    bits = 8 * SIZES[type_]
    return f"({c_type}){number % 2**bits}ull"


class _Translator:
    """One function."""

    def __init__(self, whole: _Whole, function: Function) -> None:
        self.whole, self.function = whole, function
        self.lines: list[str] = []
        self.registers: dict[str, str] = {}  # C++ name -> C++ type
        self.scopes: list[dict[str, tuple[str, int | None]]] = []
        self.symbols: list[dict[str, str]] = []
        self.scope_names: list[int] = []
        self.local_bytes = 0
        self.resumes = 0
        self.locals: list[str] = []
        self.targets: dict[str, tuple[str, ...]] = {}
        self.seen_labels: set[str] = set()
        self.scopes_opened = 0
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

    # Scopes, names, operands

    def push(self) -> None:
        self.scopes.append({})
        self.symbols.append({})
        self.scope_names.append(self.scopes_opened)
        self.scopes_opened += 1

    def pop(self) -> None:
        self.scopes.pop()
        self.symbols.pop()
        self.scope_names.pop()

    def register(self, name: str) -> str | None:
        """C++ name of a register, or None where the name is none."""
        found = re.match(r"^(.*?)(\d+)$", name)
        for scope, number in zip(reversed(self.scopes), reversed(self.scope_names), strict=True):
            if name in scope and scope[name][1] is None:
                type_ = scope[name][0]
            elif found and found[1] in scope and scope[found[1]][1] and int(found[2]) < scope[found[1]][1]:
                type_ = scope[found[1]][0]
            else:
                continue
            c = _c_name(name) + (f"_{number}" if number else "")
            self.registers.setdefault(c, C_TYPES[type_])
            return f"R.{c}"
        return None

    def symbol(self, name: str) -> str | None:
        for scope in reversed(self.symbols):
            if name in scope:
                return scope[name]
        return self.whole.symbol(name)

    def read(self, operand: str, type_: str) -> str:
        """C++ of an operand read as ``type_``."""
        negated = operand.startswith("!")
        operand = operand.lstrip("!").strip()
        register = self.register(operand)
        c_type = C_TYPES[type_]
        if register is not None:
            if self.registers[register[2:]] == c_type:
                value = register
            elif type_ == "pred":
                raise UnknownPtx(f"PTX register {operand} is read as a predicate")
            else:
                value = f"rd<{c_type}>({register})"
        elif operand in SPECIAL:
            value = f"({c_type}){SPECIAL[operand]}"
        elif re.match(r"^[-+~]?\d", operand):
            value = _immediate(operand, type_)
        else:
            value = f"({c_type}){self.address(operand)}"
        return f"!{value}" if negated else value

    def address(self, text: str) -> str:
        """C++ of an address: register, symbol or constant, with an offset."""
        found = re.match(r"^([^+\s]+)\s*(?:\+\s*(-?\w+))?$", text.strip())
        if found is None:
            raise UnknownPtx(f"PTX address {text!r} is not understood")
        base, offset = found[1], found[2]
        register = self.register(base)
        if register is not None:
            value = register if self.registers[register[2:]] == "u64" else f"(u64)(u32){register}"
        elif re.match(r"^\d", base):
            value = _immediate(base, "u64")
        else:
            symbol = self.symbol(base)
            if symbol is None:
                raise UnknownPtx(f"PTX name {base!r} is not known")
            value = f"(u64){symbol}"
        return value if not offset else f"({value} + (u64)({int(offset, 0)}ll))"

    def write(self, operand: str, value: str) -> str:
        """C++ statement that writes a typed C++ value to a register."""
        if operand == "_":
            return f"(void)({value});"
        register = self.register(operand)
        if register is None:
            raise UnknownPtx(f"PTX register {operand!r} is not declared")
        return f"wr({register}, {value});"

    # Statements

    def translate(self) -> str:
        f = self.function
        self.push()
        for i, p in enumerate(f.params):
            self.symbols[0][p.name] = f"(u64)C->params[{i}]" if f.entry else _c_name(p.name)
        for p in f.results:
            self.symbols[0][p.name] = _c_name(p.name)
        self.block()
        for s in f.body or []:
            if s.what == "targets":
                self.targets[s.name] = s.operands
        for s in f.body or []:
            self.statement(s)
        body = "\n".join(self.lines)
        name = "Registers" if f.entry else f"Registers_{_c_name(f.name)}"
        fields = "".join(f" {t} {c};" for c, t in self.registers.items())
        depot = f" alignas(16) char local[{self.local_bytes}];" if self.local_bytes else ""
        struct = f"struct {name} {{ u32 resume; bool carry;{fields} }};"
        local = f"struct {name}_local {{{depot} }};"
        if not f.entry:
            head = f"static {self.whole.signature(f.name)}\n{{\n{name} R = {{}};\n{name}_local L;\n"
            return f"{struct}\n{local}\n{head}{body}\n}}"
        if not self.waits:
            head = f"static __attribute__((noinline)) void run_thread(Context* C, u32 t)\n{{\nThread& T = C->threads[t];\n{name} R = {{}};\n"
            return f"{struct}\n{local}\n{head}{name}_local L;\n{body}\n}}"
        cases = "".join(f"case {k}: goto resume_{k}; " for k in range(1, self.resumes + 1))
        struct = f"struct {name}_local {{{depot} }};\n" + struct.replace(" }", f" {name}_local local; }}", 1)
        restart = "__builtin_memset(&R, 0, sizeof(R)); __builtin_memset(&R.local, 0xff, sizeof(R.local));"
        # A finished thread of the block before left its registers: the scheduler resets the place to resume from.
        return (
            f"{struct}\nstatic __attribute__((noinline)) void run_thread(Context* C, u32 t)\n{{\nThread& T = C->threads[t];\n"
            f"{name}* __restrict registers = ({name}*)C->registers + t;\n{name}& R = *registers;\n"
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
            self.lines.append(f"{_c_name(s.name)}: ;")
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
            c = f"{_c_name(v.name)}_{self.scope_names[-1]}"
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

    def type_of(self, s: Statement, mods: list[str], allowed: set[str] | frozenset[str] = frozenset()) -> str:
        """The instruction's one type; other modifiers must be among ``allowed``."""
        types = [m for m in mods if m in C_TYPES]
        unknown = [m for m in mods if m not in C_TYPES and m not in allowed]
        if unknown or len(types) != 1:
            raise UnknownPtx(
                f"PTX instruction {s.opcode} (modifiers {', '.join(unknown) or 'of its types'}) is not known"
            )
        return types[0]

    def fault(self, what: str, s: Statement) -> str:
        return f"fault(C, {what}, {self.whole.site(s)}u)"

    # Moves and memory

    def op_mov(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        target, source = ops
        if target.startswith("{"):
            parts = split(target[1:-1])
            bits = 8 * SIZES[type_] // len(parts)
            value = self.read(source, f"b{8 * SIZES[type_]}")
            out = [f"{{ const u64 whole_ = {value};"]
            out += [
                self.write(p, f"(u{bits})(whole_ >> {k * bits})") for k, p in enumerate(parts) if p != "_"
            ]
            return [*out, "}"]
        if source.startswith("{"):
            parts = split(source[1:-1])
            bits = 8 * SIZES[type_] // len(parts)
            terms = [f"((u64){self.read(p, f'b{bits}')} << {k * bits})" for k, p in enumerate(parts)]
            return [self.write(target, f"(u{8 * SIZES[type_]})({' | '.join(terms)})")]
        return [self.write(target, self.read(source, type_))]

    def memory(self, s: Statement, operand: str, space: str, size: int, align: int) -> list[str]:
        """Statements that leave the host address of ``operand`` in ``at_``; they open a brace."""
        inner = operand.strip()
        if not inner.startswith("["):
            raise UnknownPtx(f"PTX operand {operand!r} is no address")
        address = self.address(inner[1:-1])
        out = [f"{{ u64 at_ = {address};"]
        if space == "param":
            return out
        kind = "shared" if space == "shared" else "memory"
        if space == "shared":
            bad = f"bad_shared(C, at_, {size}u, {align}u)"
        else:
            bad = f"bad_address(at_, {align.bit_length() - 1}u)"
        out.append(f"if (UNLIKELY({bad})) bad_{kind}_access(C, at_, {self.whole.site(s)}u);")
        if space == "shared":
            out.append("at_ = (u64)C->shared + (u32)at_;")
        return out

    def access(self, s: Statement, mods: list[str]) -> tuple[str, str, int]:
        """Space, element type and number of elements of a load or store."""
        type_ = self.type_of(s, mods, SPACES | ORDERS | CACHES | SCOPES | {"v2", "v4", "v8"})
        space = next((m for m in mods if m in SPACES), "generic")
        count = next((int(m[1:]) for m in mods if m in ("v2", "v4", "v8")), 1)
        return space, type_, count

    def op_ld(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        space, type_, count = self.access(s, mods)
        size = SIZES[type_]
        targets = split(ops[0][1:-1]) if count > 1 else [ops[0]]
        if len(targets) != count:
            raise UnknownPtx(f"PTX {s.opcode} has {len(targets)} registers")
        out = self.memory(s, ops[1], space, size * count, size * count)
        c = C_TYPES[type_]
        out += [self.write(r, f"ldm<{c}>(at_ + {k * size})") for k, r in enumerate(targets) if r != "_"]
        return [*out, "}"]

    def op_ldu(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.op_ld(s, mods, ops)

    def op_st(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        space, type_, count = self.access(s, mods)
        size = SIZES[type_]
        sources = split(ops[1][1:-1]) if count > 1 else [ops[1]]
        if len(sources) != count:
            raise UnknownPtx(f"PTX {s.opcode} has {len(sources)} values")
        out = self.memory(s, ops[0], space, size * count, size * count)
        c = C_TYPES[type_]
        out += [f"stm<{c}>(at_ + {k * size}, {self.read(r, type_)});" for k, r in enumerate(sources)]
        return [*out, "}"]

    def op_cvta(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, SPACES | {"to"})
        value = self.read(ops[1], type_)
        if "shared" in mods:
            if type_ != "u64":
                raise UnknownPtx(f"PTX {s.opcode} is not known")
            value = f"{value} - (u64)C->shared" if "to" in mods else f"{value} + (u64)C->shared"
        return [self.write(ops[0], f"(u64)({value})")]

    def op_isspacep(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        if mods not in (["shared"], ["global"]):
            raise UnknownPtx(f"PTX {s.opcode} is not known")
        inside = f"({self.read(ops[1], 'u64')} - (u64)C->shared < C->shared_bytes)"
        return [self.write(ops[0], inside if mods == ["shared"] else f"!{inside}")]

    def op_prefetch(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return []

    op_prefetchu = op_prefetch
    op_membar = op_prefetch  # one block runs at a time and memory is the host's
    op_fence = op_prefetch
    op_nanosleep = op_prefetch

    # Integers and floats alike

    def op_add(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.sum(s, mods, ops, "+")

    def op_sub(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.sum(s, mods, ops, "-")

    def sum(self, s: Statement, mods: list[str], ops: tuple[str, ...], sign: str) -> list[str]:
        type_ = self.type_of(s, mods, {*ROUNDINGS, "ftz", "sat", "cc"})
        a, b = (self.read(x, type_) for x in ops[1:])
        c = C_TYPES[type_]
        if type_[0] == "f":
            return self.float_result(s, ops[0], mods, type_, [a, b], f"sum_{sign}")
        unsigned = f"u{8 * SIZES[type_]}"
        if "cc" in mods:
            which = "add" if sign == "+" else "sub"
            return [
                f"{{ {unsigned} y_; R.carry = __builtin_{which}_overflow(({unsigned}){a}, ({unsigned}){b}, &y_);",
                self.write(ops[0], "y_"),
                "}",
            ]
        if "sat" in mods:
            return [self.write(ops[0], f"clamped<{c}>((s64){a} {sign} (s64){b})")]
        return [self.write(ops[0], f"({c})(({unsigned}){a} {sign} ({unsigned}){b})")]

    def op_addc(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.with_carry(s, mods, ops, "+")

    def op_subc(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.with_carry(s, mods, ops, "-")

    def with_carry(self, s: Statement, mods: list[str], ops: tuple[str, ...], sign: str) -> list[str]:
        type_ = self.type_of(s, mods, {"cc"})
        a, b = (self.read(x, f"u{8 * SIZES[type_]}") for x in ops[1:])
        carry = f"R.carry = (y_ >> {8 * SIZES[type_]}) & 1;" if "cc" in mods else ""
        unsigned = f"u{8 * SIZES[type_]}"
        return [
            f"{{ const u128 y_ = (u128){a} {sign} (u128){b} {sign} (u128)R.carry; {carry}",
            self.write(ops[0], f"({unsigned})y_"),
            "}",
        ]

    def float_result(
        self, s: Statement, target: str, mods: list[str], type_: str, values: list[str], what: str
    ) -> list[str]:
        """Sum, product or fused product of floats, rounded, flushed and saturated as the modifiers say."""
        rounding = ROUNDINGS[next((m for m in mods if m in ROUNDINGS), "rn")]
        if "ftz" in mods:
            values = [f"flushed({v})" for v in values]
        if what == "sum_-":
            values[1] = f"negated({values[1]})"
        if rounding == "NEAREST":
            value = {
                "sum_+": lambda: f"{values[0]} + {values[1]}",
                "sum_-": lambda: f"{values[0]} + {values[1]}",
                "product": lambda: f"{values[0]} * {values[1]}",
                "fused": lambda: f"fused({', '.join(values)})",
            }[what]()
            value = f"({value})"
        elif what == "fused":
            if type_ != "f32":
                raise UnknownPtx(f"PTX {s.opcode} is not known")
            value = f"fused_to({', '.join(values)}, {rounding})"
        else:
            value = f"{'product' if what == 'product' else 'sum'}_to({values[0]}, {values[1]}, {rounding})"
        if "ftz" in mods:
            value = f"flushed({value})"
        if "sat" in mods:
            value = f"saturated({value})"
        return [self.write(target, value)]

    def op_mul(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {*ROUNDINGS, "ftz", "sat", "lo", "hi", "wide"})
        a, b = (self.read(x, type_) for x in ops[1:])
        if type_[0] == "f":
            return self.float_result(s, ops[0], mods, type_, [a, b], "product")
        return [self.write(ops[0], self.product(type_, mods, a, b))]

    def product(self, type_: str, mods: list[str], a: str, b: str) -> str:
        bits = 8 * SIZES[type_]
        wide = f"{type_[0].replace('b', 'u')}{2 * bits}" if bits < 64 else f"{type_[0].replace('b', 'u')}128"
        if "wide" in mods:
            return f"({wide})({wide}{{{a}}} * {wide}{{{b}}})"
        if "hi" in mods:
            return f"({C_TYPES[type_]})(({wide}{{{a}}} * {wide}{{{b}}}) >> {bits})"
        if "lo" not in mods:
            raise UnknownPtx("PTX integer product without .lo, .hi or .wide")
        middle = "u64" if bits == 64 else "u32"
        return f"({C_TYPES[type_]})(({middle}){a} * ({middle}){b})"

    def op_mad(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {*ROUNDINGS, "ftz", "sat", "lo", "hi", "wide", "cc"})
        if type_[0] == "f":
            return self.op_fma(s, mods, ops)
        return self.multiply_add(s, mods, ops, type_, "0")

    def op_madc(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.multiply_add(s, mods, ops, self.type_of(s, mods, {"lo", "hi", "cc"}), "R.carry")

    def multiply_add(
        self, s: Statement, mods: list[str], ops: tuple[str, ...], type_: str, carry: str
    ) -> list[str]:
        if "sat" in mods:
            raise UnknownPtx(f"PTX {s.opcode} is not known")
        a, b = (self.read(x, type_) for x in ops[1:3])
        bits = 8 * SIZES[type_] * (2 if "wide" in mods else 1)
        third = self.read(ops[3], f"{type_[0]}{bits}")
        out = f"({type_[0].replace('b', 'u')}{bits})"
        total = f"(u128)(u{bits})({self.product(type_, mods, a, b)}) + (u128)(u{bits}){third} + (u128){carry}"
        keep = f"R.carry = (y_ >> {bits}) & 1;" if "cc" in mods else ""
        return [f"{{ const u128 y_ = {total}; {keep}", self.write(ops[0], f"{out}y_"), "}"]

    def op_fma(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {*ROUNDINGS, "ftz", "sat"})
        return self.float_result(s, ops[0], mods, type_, [self.read(x, type_) for x in ops[1:4]], "fused")

    def op_div(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {"rn", "ftz", "approx", "full"})
        a, b = (self.read(x, type_) for x in ops[1:])
        if type_[0] != "f":
            return [self.write(ops[0], f"quotient<{C_TYPES[type_]}>({a}, {b})")]
        return [self.write(ops[0], self.flush(mods, "({0} / {1})", a, b))]

    def op_rem(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        a, b = (self.read(x, type_) for x in ops[1:])
        return [self.write(ops[0], f"remainder<{C_TYPES[type_]}>({a}, {b})")]

    def flush(self, mods: list[str], form: str, *values: str) -> str:
        if "ftz" not in mods:
            return form.format(*values)
        return f"flushed({form.format(*(f'flushed({v})' for v in values))})"

    def unary_float(self, s: Statement, mods: list[str], ops: tuple[str, ...], form: str) -> list[str]:
        type_ = self.type_of(s, mods, {"rn", "ftz", "approx"})
        if type_[0] != "f":
            raise UnknownPtx(f"PTX {s.opcode} is not known")
        if type_ == "f64" and "approx" in mods:
            return [self.write(ops[0], f"upper({form.format(f'upper({self.read(ops[1], type_)})')})")]
        return [self.write(ops[0], self.flush(mods, form, self.read(ops[1], type_)))]

    def op_rcp(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.unary_float(s, mods, ops, "(1 / {0})")

    def op_sqrt(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.unary_float(s, mods, ops, "root({0})")

    def op_rsqrt(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.unary_float(s, mods, ops, "(1 / root({0}))")

    def op_ex2(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.approximate(s, mods, ops, "exp2f({0})")

    def op_lg2(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.approximate(s, mods, ops, "log2f({0})")

    def op_sin(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.approximate(s, mods, ops, "sinf({0})")

    def op_cos(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.approximate(s, mods, ops, "cosf({0})")

    def op_tanh(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.approximate(s, mods, ops, "tanhf({0})")

    def approximate(self, s: Statement, mods: list[str], ops: tuple[str, ...], form: str) -> list[str]:
        if self.type_of(s, mods, {"ftz", "approx"}) != "f32":
            raise UnknownPtx(f"PTX {s.opcode} is not known")
        return [self.write(ops[0], self.flush(mods, form, self.read(ops[1], "f32")))]

    def extreme(
        self, s: Statement, mods: list[str], ops: tuple[str, ...], which: str, sign: str
    ) -> list[str]:
        type_ = self.type_of(s, mods, {"ftz", "NaN"})
        values = [self.read(x, type_) for x in ops[1:]]
        if type_[0] != "f":
            return [self.write(ops[0], f"({values[0]} {sign} {values[1]} ? {values[0]} : {values[1]})")]
        value = self.flush(mods, f"{which}({{0}}, {{1}})", *values)
        if "NaN" in mods:
            nan = _immediate("0f7fffffff" if type_ == "f32" else "0d7fffffffffffffff", type_)
            value = f"(is_nan({values[0]}) || is_nan({values[1]}) ? {nan} : {value})"
        return [self.write(ops[0], value)]

    def op_min(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.extreme(s, mods, ops, "least", "<")

    def op_max(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.extreme(s, mods, ops, "most", ">")

    def op_abs(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {"ftz"})
        a = self.read(ops[1], type_)
        if type_[0] == "f":
            return [self.write(ops[0], self.flush(mods, "magnitude({0})", a))]
        c, u = C_TYPES[type_], f"u{8 * SIZES[type_]}"
        return [self.write(ops[0], f"({c})({a} < 0 ? ({u})0 - ({u}){a} : ({u}){a})")]

    def op_neg(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {"ftz"})
        a = self.read(ops[1], type_)
        if type_[0] == "f":
            return [self.write(ops[0], self.flush(mods, "negated({0})", a))]
        u = f"u{8 * SIZES[type_]}"
        return [self.write(ops[0], f"({C_TYPES[type_]})(({u})0 - ({u}){a})")]

    def op_copysign(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        return [self.write(ops[0], f"with_sign({self.read(ops[1], type_)}, {self.read(ops[2], type_)})")]

    # Bits

    def bitwise(self, s: Statement, mods: list[str], ops: tuple[str, ...], form: str) -> list[str]:
        type_ = self.type_of(s, mods)
        values = [self.read(x, type_) for x in ops[1:]]
        return [self.write(ops[0], f"({C_TYPES[type_]})({form.format(*values)})")]

    def op_and(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.bitwise(s, mods, ops, "{0} & {1}")

    def op_or(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.bitwise(s, mods, ops, "{0} | {1}")

    def op_xor(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.bitwise(s, mods, ops, "{0} ^ {1}")

    def op_not(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.bitwise(s, mods, ops, "!{0}" if mods == ["pred"] else "~{0}")

    def op_cnot(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.bitwise(s, mods, ops, "{0} == 0")

    def op_lop3(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        if mods != ["b32"]:
            raise UnknownPtx(f"PTX {s.opcode} is not known")
        return [self.write(ops[0], f"logic({', '.join(self.read(x, 'u32') for x in ops[1:5])})")]

    def op_shl(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        return [
            self.write(
                ops[0],
                f"shift_left<{C_TYPES[type_]}>({self.read(ops[1], type_)}, {self.read(ops[2], 'u32')})",
            )
        ]

    def op_shr(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        return [
            self.write(
                ops[0],
                f"shift_right<{C_TYPES[type_]}>({self.read(ops[1], type_)}, {self.read(ops[2], 'u32')})",
            )
        ]

    def op_shf(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        self.type_of(s, mods, {"l", "r", "wrap", "clamp"})
        values = ", ".join(self.read(x, "u32") for x in ops[1:4])
        return [self.write(ops[0], f"funnel({values}, {int('l' in mods)}, {int('wrap' in mods)})")]

    def op_bfe(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        c, u = C_TYPES[type_], f"u{8 * SIZES[type_]}"
        place, length = (self.read(x, "u32") for x in ops[2:4])
        return [self.write(ops[0], f"field<{c}, {u}>({self.read(ops[1], type_)}, {place}, {length})")]

    def op_bfi(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        a, b = (self.read(x, type_) for x in ops[1:3])
        place, length = (self.read(x, "u32") for x in ops[3:5])
        return [self.write(ops[0], f"with_field<{C_TYPES[type_]}>({a}, {b}, {place}, {length})")]

    def op_bfind(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {"shiftamt"})
        amount = "true" if "shiftamt" in mods else "false"
        return [self.write(ops[0], f"highest_bit<{C_TYPES[type_]}>({self.read(ops[1], type_)}, {amount})")]

    def op_brev(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.bitwise(s, mods, ops, "reversed({0})")

    def op_clz(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        return [self.write(ops[0], f"leading_zeros({self.read(ops[1], type_)}, {8 * SIZES[type_]})")]

    def op_popc(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        return [self.write(ops[0], f"(u32)__builtin_popcountll({self.read(ops[1], type_)})")]

    def op_prmt(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        if mods != ["b32"]:
            raise UnknownPtx(f"PTX {s.opcode} is not known")
        return [self.write(ops[0], f"permuted({', '.join(self.read(x, 'u32') for x in ops[1:4])})")]

    # Comparisons and conversions

    def compare(self, comparison: str, type_: str, a: str, b: str, ftz: bool) -> str:
        if type_[0] != "f":
            return f"({a} {COMPARISONS[comparison]} {b})"
        if ftz:
            a, b = f"flushed({a})", f"flushed({b})"
        if comparison == "num":
            return f"(!is_nan({a}) && !is_nan({b}))"
        if comparison == "nan":
            return f"(is_nan({a}) || is_nan({b}))"
        if comparison == "ne":  # ordered: false where one is NaN
            return f"({a} < {b} || {a} > {b})"
        if comparison in ("equ", "neu", "ltu", "leu", "gtu", "geu"):
            return f"(is_nan({a}) || is_nan({b}) || {a} {COMPARISONS[comparison[:-1]]} {b})"
        return f"({a} {COMPARISONS[comparison]} {b})"

    def op_setp(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        booleans = {"and": "&", "or": "|", "xor": "^"}
        allowed = {*COMPARISONS, "equ", "neu", "ltu", "leu", "gtu", "geu", "num", "nan", "ftz", *booleans}
        type_ = self.type_of(s, mods, allowed)
        a, b = (self.read(x, type_) for x in ops[1:3])
        met = self.compare(mods[0], type_, a, b, "ftz" in mods)
        targets = split(ops[0], "|")
        combine = next((m for m in mods[1:] if m in booleans), None)
        out = [f"{{ const bool met_ = {met};"]
        if combine:
            out.append(f"const bool with_ = {self.read(ops[3], 'pred')};")
        for target, value in zip(targets, ("met_", "!met_"), strict=False):
            combined = f"(bool)({value} {booleans[combine]} with_)" if combine else value
            out.append(self.write(target, combined))
        return [*out, "}"]

    def op_set(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        if len(mods) != 3 or len(ops) != 3:
            raise UnknownPtx(f"PTX {s.opcode} is not known")
        met = self.compare(mods[0], mods[2], self.read(ops[1], mods[2]), self.read(ops[2], mods[2]), False)
        yes = "1.0f" if mods[1] == "f32" else f"({C_TYPES[mods[1]]})-1"
        return [self.write(ops[0], f"({met} ? {yes} : ({C_TYPES[mods[1]]})0)")]

    def op_selp(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods)
        a, b = (self.read(x, type_) for x in ops[1:3])
        return [self.write(ops[0], f"({self.read(ops[3], 'pred')} ? {a} : {b})")]

    def op_testp(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        type_ = self.type_of(s, mods, {"finite", "infinite", "number", "notanumber"})
        a = self.read(ops[1], type_)
        infinite = f"magnitude({a}) == ({type_})__builtin_inf()"
        form = {
            "finite": f"!is_nan({a}) && !({infinite})", "infinite": infinite, "number": f"!is_nan({a})",
            "notanumber": f"is_nan({a})",
        }  # fmt: skip
        return [self.write(ops[0], f"({form[mods[0]]})")]

    def op_cvt(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        known = {*ROUNDINGS, *WHOLE, "ftz", "sat"}
        types = [m for m in mods if m in C_TYPES]
        unknown = [m for m in mods if m not in C_TYPES and m not in known]
        if unknown or len(types) != 2:
            raise UnknownPtx(f"PTX instruction {s.opcode} is not known")
        to, source = types
        a, c = self.read(ops[1], source), C_TYPES[to]
        if "ftz" in mods and source == "f32":
            a = f"flushed({a})"
        rounding = next((ROUNDINGS[m] for m in mods if m in ROUNDINGS), "NEAREST")
        whole = next((WHOLE[m] for m in mods if m in WHOLE), None)
        if source[0] == "f" and to[0] == "f":
            if source == to:
                value = f"whole({a}, {whole})" if whole else a
            elif to == "f32":
                value = f"narrowed({a}, {rounding})"
            else:
                value = f"(f64){a}"
            if "ftz" in mods and to == "f32":
                value = f"flushed({value})"
            value = f"saturated({value})" if "sat" in mods else value
        elif source[0] == "f":
            if whole is None:
                raise UnknownPtx(f"PTX {s.opcode} has no rounding")
            value = f"to_integer<{c}>({a}, {whole})"
        elif to[0] == "f":
            if rounding != "NEAREST":
                if to != "f32" or SIZES[source] > 4:
                    raise UnknownPtx(f"PTX {s.opcode} is not known")
                value = f"narrowed((f64){a}, {rounding})"
            else:
                value = f"({c}){a}"
        else:
            value = f"clamped<{c}>({a})" if "sat" in mods else f"({c}){a}"
        return [self.write(ops[0], value)]

    # Atomics: plain, as one thread runs at a time

    def op_atom(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.atomic(s, mods, ops[0], ops[1], ops[2:])

    def op_red(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return self.atomic(s, mods, "_", ops[0], ops[1:])

    def atomic(
        self, s: Statement, mods: list[str], target: str, place: str, values: tuple[str, ...]
    ) -> list[str]:
        kinds = {"add", "min", "max", "inc", "dec", "and", "or", "xor", "exch", "cas"}
        type_ = self.type_of(s, mods, SPACES | ORDERS | SCOPES | kinds | {"v2", "v4", "v8", "noftz"})
        kind = next(m for m in mods if m in kinds)
        space = next((m for m in mods if m in SPACES), "generic")
        count = next((int(m[1:]) for m in mods if m in ("v2", "v4", "v8")), 1)
        size, c = SIZES[type_], C_TYPES[type_]
        lists = [split(v[1:-1]) if count > 1 else [v] for v in values]
        targets = split(target[1:-1]) if target.startswith("{") else [target] * count
        out = self.memory(s, place, space, size * count, size * count)
        for k in range(count):
            a = [self.read(v[k], type_) for v in lists]
            fresh = {
                "add": lambda a=a: f"old_ + {a[0]}",
                "min": lambda a=a: (
                    f"least(old_, {a[0]})" if type_[0] == "f" else f"(old_ < {a[0]} ? old_ : {a[0]})"
                ),
                "max": lambda a=a: (
                    f"most(old_, {a[0]})" if type_[0] == "f" else f"(old_ > {a[0]} ? old_ : {a[0]})"
                ),
                "inc": lambda a=a: f"(old_ >= {a[0]} ? 0 : old_ + 1)",
                "dec": lambda a=a: f"(old_ == 0 || old_ > {a[0]} ? {a[0]} : old_ - 1)",
                "and": lambda a=a: f"old_ & {a[0]}",
                "or": lambda a=a: f"old_ | {a[0]}",
                "xor": lambda a=a: f"old_ ^ {a[0]}",
                "exch": lambda a=a: a[0],
                "cas": lambda a=a: f"(old_ == {a[0]} ? {a[1]} : old_)",
            }[kind]()
            out.append(
                f"{{ const {c} old_ = ldm<{c}>(at_ + {k * size}); stm<{c}>(at_ + {k * size}, ({c})({fresh}));"
            )
            out.append("" if targets[k] == "_" else self.write(targets[k], "old_"))
            out.append("}")
        return [*out, "}"]

    # Control

    def jump(self, label: str, s: Statement) -> str:
        go = f"goto {_c_name(label)};"
        if label in self.seen_labels:  # backwards: a loop that does not end is found out
            return f"if (UNLIKELY(--C->budget < 0)) {self.fault('TOO_LONG', s)}; {go}"
        return go

    def op_bra(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return [self.jump(ops[0], s)]

    def op_brx(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        cases = " ".join(
            f"case {k}: {{ {self.jump(label, s)} }}" for k, label in enumerate(self.targets[ops[1]])
        )
        return [f"switch ({self.read(ops[0], 'u32')}) {{ {cases} default: {self.fault('TRAP', s)}; }}"]

    def op_ret(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return [self.done()]

    def op_exit(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        if not self.function.entry:
            raise UnknownPtx("PTX exit inside a device function is not known")
        return [self.done()]

    def op_trap(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return [self.fault("TRAP", s) + ";"]

    op_brkpt = op_trap

    def op_call(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        groups = list(ops)
        results = split(groups.pop(0)[1:-1]) if groups[0].startswith("(") else []
        name = groups.pop(0)
        arguments = split(groups.pop(0)[1:-1]) if groups else []
        if groups:
            raise UnknownPtx("PTX indirect call is not known")
        places = [self.symbol(x) for x in [*results, *arguments]]
        if any(p is None for p in places):
            raise UnknownPtx("PTX call passes what is no parameter")
        if name == "vprintf":
            text, values = (f"(const char*)ldm<u64>((u64){p})" for p in places[1:])
            return [f"C->print({text}, {values}); stm<u32>((u64){places[0]}, 0u);"]
        if name == "__assertfail":
            return [f"C->address = ldm<u64>((u64){places[0]}); {self.fault('ASSERTION', s)};"]
        self.whole.require(name)
        passed = "".join(f", (u64){p}" for p in places)
        return [f"{_c_name(name)}(C, t{passed});"]

    # What waits for other threads

    def wait(self, s: Statement, wait: str, **fields: str) -> list[str]:
        """Leave the thread waiting; execution goes on behind."""
        self.resumes += 1
        k = self.resumes
        settings = " ".join(f"T.{name} = {value};" for name, value in fields.items())
        return [
            f"T.wait = {wait}; T.state = WAITING; T.site = {self.whole.site(s)}u; {settings}",
            f"R.resume = {k}; return; resume_{k}: ;",
        ]

    def op_bar(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        mods = [m for m in mods if m not in ("aligned", "cta")]
        if mods == ["warp", "sync"]:
            return self.wait(s, "WARP_BARRIER", mask=self.read(ops[0], "u32"), kind="0")
        if mods == ["sync"]:
            count = self.read(ops[1], "u32") if len(ops) > 1 else "0"
            return self.wait(s, "BARRIER", mask=self.read(ops[0], "u32"), count=count, flag="0", kind="0")
        if mods == ["arrive"]:
            return [f"++C->arrived[{self.read(ops[0], 'u32')} & 15];"]
        if mods in (["red", "and", "pred"], ["red", "or", "pred"], ["red", "popc", "u32"]):
            count = self.read(ops[2], "u32") if len(ops) > 3 else "0"
            brought = self.read(ops[-1], "pred")
            kind = "0" if "and" in mods else "1"
            out = self.wait(s, "BARRIER", mask=self.read(ops[1], "u32"), count=count, flag=brought, kind=kind)
            return [*out, self.write(ops[0], "(u32)T.value" if "popc" in mods else "(bool)T.flag")]
        raise UnknownPtx(f"PTX instruction {s.opcode} is not known")

    op_barrier = op_bar

    def op_shfl(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        kinds = {"up": "0", "down": "1", "bfly": "2", "idx": "3"}
        if len(mods) != 3 or mods[0] != "sync" or mods[2] != "b32":
            raise UnknownPtx(f"PTX instruction {s.opcode} is not known")
        a, b, c, mask = (self.read(x, "u32") for x in ops[1:5])
        out = self.wait(s, "SHUFFLE", kind=kinds[mods[1]], mask=mask, value=a, lane_from=b, clamp=c)
        return [*out, *self.results(ops[0], "(u32)T.value")]

    def results(self, operand: str, value: str) -> list[str]:
        """Write a value, and the predicate that may come with it."""
        targets = split(operand, "|")
        return [self.write(targets[0], value), *(self.write(p, "(bool)T.flag") for p in targets[1:])]

    def op_vote(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        kinds = {"all": "0", "any": "1", "uni": "2", "ballot": "3"}
        if len(mods) != 3 or mods[0] != "sync":
            raise UnknownPtx(f"PTX instruction {s.opcode} is not known")
        out = self.wait(
            s, "VOTE", kind=kinds[mods[1]], mask=self.read(ops[2], "u32"), flag=self.read(ops[1], "pred")
        )
        return [*out, self.write(ops[0], "(u32)T.value" if mods[1] == "ballot" else "(bool)T.flag")]

    def op_match(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        kinds = {"any": "0", "all": "1"}
        if len(mods) != 3 or mods[1] != "sync":
            raise UnknownPtx(f"PTX instruction {s.opcode} is not known")
        out = self.wait(
            s, "MATCH", kind=kinds[mods[0]], mask=self.read(ops[2], "u32"), value=self.read(ops[1], mods[2])
        )
        return [*out, *self.results(ops[0], "(u32)T.value")]

    def op_redux(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        kinds = {"add": 0, "min": 1, "max": 2, "and": 5, "or": 6, "xor": 7}
        if len(mods) != 3 or mods[0] != "sync" or mods[2][0] == "f":
            raise UnknownPtx(f"PTX instruction {s.opcode} is not known")
        kind = kinds[mods[1]] + (2 if mods[2] == "s32" and mods[1] in ("min", "max") else 0)
        out = self.wait(
            s, "REDUCE", kind=str(kind), mask=self.read(ops[2], "u32"), value=self.read(ops[1], "u32")
        )
        return [*out, self.write(ops[0], "(u32)T.value")]

    def op_activemask(self, s: Statement, mods: list[str], ops: tuple[str, ...]) -> list[str]:
        return [*self.wait(s, "ACTIVE_MASK", kind="0"), self.write(ops[0], "(u32)T.value")]


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
