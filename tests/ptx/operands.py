"""Registers, variables and constants of PTX as C++ expressions, and what an instruction's modifiers say."""

from __future__ import annotations

import re
from typing import Any

from ptx.parse import SIZES, Function, Statement, UnknownPtx

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


def c_name(name: str) -> str:
    return "v_" + re.sub(r"\W", "_", name.replace("%", "").replace("$", "S_").replace(".", "_"))


def immediate(text: str, type_: str) -> str:
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


class Operands:
    """Names in scope in one function, read and written as C++; the lines made of it so far."""

    def __init__(self, whole: Any, function: Function) -> None:
        self.whole, self.function = whole, function
        self.lines: list[str] = []
        self.registers: dict[str, str] = {}  # C++ name -> C++ type
        self.scopes: list[dict[str, tuple[str, int | None]]] = []
        self.symbols: list[dict[str, str]] = []
        self.scope_names: list[int] = []
        self.scopes_opened = 0
        self.resumes = 0
        self.targets: dict[str, tuple[str, ...]] = {}
        self.seen_labels: set[str] = set()

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
            c = c_name(name) + (f"_{number}" if number else "")
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
            value = immediate(operand, type_)
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
            value = immediate(base, "u64")
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
