"""PTX instructions that move data, touch memory, jump, or wait for other threads.

A method ``op_x`` returns the C++ lines of instruction ``x``. One thread runs at a time, so atomics are plain.
"""

from __future__ import annotations

from ptx.operands import C_TYPES, CACHES, ORDERS, SCOPES, SPACES, Operands, c_name
from ptx.parse import SIZES, Statement, UnknownPtx, split


class Effects(Operands):
    """Moves, loads and stores, atomics, control, barriers, shuffles and votes."""

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
        go = f"goto {c_name(label)};"
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
        return [f"{c_name(name)}(C, t{passed});"]

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
