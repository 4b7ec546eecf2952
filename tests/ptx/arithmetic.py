"""PTX instructions that compute registers from registers: PTX ISA 9.0, chapters 9.7.1 to 9.7.8 and conversions.

A method ``op_x`` returns the C++ lines of instruction ``x``.
"""

from __future__ import annotations

from ptx.operands import C_TYPES, COMPARISONS, ROUNDINGS, WHOLE, Operands, immediate
from ptx.parse import SIZES, Statement, UnknownPtx, split


class Arithmetic(Operands):
    """Integers, floating point, bits, comparisons and conversions."""

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
            nan = immediate("0f7fffffff" if type_ == "f32" else "0d7fffffffffffffff", type_)
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
