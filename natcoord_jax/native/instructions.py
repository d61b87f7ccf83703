"""Instructions of LLVM for operations of numbers, or of vectors of a number for each lane."""

import struct
from typing import Any

LLVM = {
    "f64": "double", "f32": "float", "i64": "i64", "i32": "i32", "i16": "i16", "i8": "i8",
    "u64": "i64", "u32": "i32", "u16": "i16", "u8": "i8", "b": "i1",
}  # fmt: skip
"""Types of numbers."""

BYTES = {
    "f64": 8, "f32": 4, "i64": 8, "i32": 4, "i16": 2, "i8": 1, "u64": 8, "u32": 4, "u16": 2, "u8": 1, "b": 1,
}  # fmt: skip

FLOATS = frozenset(("f64", "f32"))
UNSIGNED = frozenset(("u64", "u32", "u16", "u8", "b"))

LIBRARY = frozenset(
    "sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log1p cbrt erf erfc "
    "atan2 pow nextafter fmod".split()
)
"""Functions of the C library."""

INTRINSICS = {"sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "round": "round", "roundeven": "roundeven"}


def memory_type(type: str) -> str:
    """The type that a number has in memory."""
    return "i8" if type == "b" else LLVM[type]


def number(value: Any, type: str) -> str:
    """A known number."""
    if type == "b":
        return "true" if value else "false"
    if type in FLOATS:
        # Both types are written as doubles.
        return f"0x{struct.unpack('<Q', struct.pack('<d', float(value)))[0]:016X}"
    return str(int(value))


class Instructions:
    """The text of operations for so many lanes.

    Attributes:
        lines: of the piece of code at hand.
        functions: declarations and functions that it asks for, by name.
    """

    def __init__(self, lanes: int):
        self.lanes = lanes
        self.lines: list[str] = []
        self.functions: dict[str, str] = {}
        self._names = 0

    def fresh(self) -> str:
        """A name."""
        self._names += 1
        return f"%t{self._names}"

    def emit(self, text: str) -> str:
        """An instruction with a result; returns its name."""
        name = self.fresh()
        self.lines.append(f"{name} = {text}")
        return name

    def typed(self, type: str, wide: bool) -> str:
        """A type, of numbers or of vectors of them."""
        return f"<{self.lanes} x {LLVM[type]}>" if wide else LLVM[type]

    def known(self, value: Any, type: str, wide: bool) -> str:
        """A known number, in all lanes."""
        text = number(value, type)
        return f"splat ({LLVM[type]} {text})" if wide else text

    def suffix(self, type: str, wide: bool) -> str:
        """Of the names of intrinsics."""
        short = {"f64": "f64", "f32": "f32"}.get(type, LLVM[type])
        return f"v{self.lanes}{short}" if wide else short

    def intrinsic(self, name: str, type: str, wide: bool, *args: str) -> str:
        """A call of a function of the compiler of as many operands of one type."""
        kind, full = self.typed(type, wide), f"@llvm.{name}.{self.suffix(type, wide)}"
        self.functions[full] = f"declare {kind} {full}({', '.join([kind] * len(args))})"
        return self.emit(f"call {kind} {full}({', '.join(f'{kind} {x}' for x in args)})")

    def library(self, name: str, type: str, wide: bool, *args: str) -> str:
        """A call of a function of the C library, in one lane after the other."""
        scalar, kind = LLVM[type], self.typed(type, wide)
        plain = f"@{name}{'f' if type == 'f32' else ''}"
        self.functions[plain] = (
            f"declare {scalar} {plain}({', '.join([scalar] * len(args))}) nounwind memory(none)"
        )
        if not wide:
            return self.emit(f"call {scalar} {plain}({', '.join(f'{scalar} {x}' for x in args)})")
        full = f"{plain}.lanes"
        if full not in self.functions:
            names = [f"%x{k}" for k in range(len(args))]
            lines = [f"define internal {kind} {full}({', '.join(f'{kind} {x}' for x in names)}) noinline {{"]
            last = "poison"
            for lane in range(self.lanes):
                for k, x in enumerate(names):
                    lines.append(f"%a{lane}.{k} = extractelement {kind} {x}, i32 {lane}")
                given = ", ".join(f"{scalar} %a{lane}.{k}" for k in range(len(args)))
                lines.append(f"%c{lane} = call {scalar} {plain}({given})")
                lines.append(f"%r{lane} = insertelement {kind} {last}, {scalar} %c{lane}, i32 {lane}")
                last = f"%r{lane}"
            self.functions[full] = "\n".join([*lines, f"ret {kind} {last}", "}"])
        return self.emit(f"call {kind} {full}({', '.join(f'{kind} {x}' for x in args)})")

    def operation(self, op: str, type: str, given: str, wide: bool, args: list[str]) -> str:
        """An operation of numbers of a given type; returns the name of the result."""
        kind = self.typed(given, wide)
        if op in COMPARED:
            floats, signed, unsigned = COMPARED[op]
            if given in FLOATS:
                return self.emit(f"fcmp {floats} {kind} {args[0]}, {args[1]}")
            return self.emit(f"icmp {unsigned if given in UNSIGNED else signed} {kind} {args[0]}, {args[1]}")
        if op in ("max", "min"):
            return self._extreme(op, given, wide, args)
        if op in ("div", "rem") and given not in FLOATS:
            return self._divided(op, given, wide, args)
        if op in LIBRARY or op == "rem":
            return self.library("fmod" if op == "rem" else op, given, wide, *args)
        if op in INTRINSICS:
            return self.intrinsic(INTRINSICS[op], given, wide, *args)
        simple = (FLOAT_BINARY if given in FLOATS else BINARY).get(op)
        if simple is not None:
            return self.emit(f"{simple} {kind} {args[0]}, {args[1]}")
        return self._unary(op, type, given, wide, args[0])

    def _unary(self, op: str, type: str, given: str, wide: bool, x: str) -> str:
        kind = self.typed(given, wide)
        if op == "neg":
            return self.emit(
                f"fneg {kind} {x}" if given in FLOATS else f"sub {kind} {self.known(0, given, wide)}, {x}"
            )
        if op == "not":
            return self.emit(f"xor {kind} {x}, {self.known(True if given == 'b' else -1, given, wide)}")
        if op == "abs":
            if given in FLOATS:
                return self.intrinsic("fabs", given, wide, x)
            less = self.emit(f"icmp slt {kind} {x}, {self.known(0, given, wide)}")
            negative = self.emit(f"sub {kind} {self.known(0, given, wide)}, {x}")
            return x if given in UNSIGNED else self.chosen(less, negative, x, given, wide)
        if op == "isfinite":
            size = self.intrinsic("fabs", given, wide, x)
            return self.emit(f"fcmp olt {kind} {size}, {self.known(float('inf'), given, wide)}")
        if op == "bitcast":
            return self.emit(f"bitcast {kind} {x} to {self.typed(type, wide)}")
        raise NotImplementedError(op)

    def chosen(self, which: str, yes: str, no: str, type: str, wide: bool) -> str:
        """One of two numbers."""
        kind, test = self.typed(type, wide), self.typed("b", wide)
        return self.emit(f"select {test} {which}, {kind} {yes}, {kind} {no}")

    def _extreme(self, op: str, type: str, wide: bool, args: list[str]) -> str:
        """The larger or smaller number, NaN if any is."""
        kind = self.typed(type, wide)
        a, b = args
        if type not in FLOATS:
            order = ("u" if type in UNSIGNED else "s") + ("gt" if op == "max" else "lt")
            return self.chosen(self.emit(f"icmp {order} {kind} {a}, {b}"), a, b, type, wide)
        wins = self.emit(f"fcmp {'ogt' if op == 'max' else 'olt'} {kind} {a}, {b}")
        no_number = self.emit(f"fcmp uno {kind} {a}, {a}")
        either = self.emit(f"or {self.typed('b', wide)} {wins}, {no_number}")
        return self.chosen(either, a, b, type, wide)

    def _divided(self, op: str, type: str, wide: bool, args: list[str]) -> str:
        """Of integers, without traps: by zero it is -1, and the remainder the number."""
        kind, (a, b) = self.typed(type, wide), args
        one, zero, minus = (self.known(x, type, wide) for x in (1, 0, -1))
        none = self.emit(f"icmp eq {kind} {b}, {zero}")
        unsafe = none
        if type not in UNSIGNED:
            unsafe = self.emit(
                f"or {self.typed('b', wide)} {none}, {self.emit(f'icmp eq {kind} {b}, {minus}')}"
            )
        safe = self.chosen(unsafe, one, b, type, wide)
        sign = "u" if type in UNSIGNED else "s"
        if op == "rem":
            found = self.emit(f"{sign}rem {kind} {a}, {safe}")
            return self.chosen(none, a, found, type, wide)
        found = self.emit(f"{sign}div {kind} {a}, {safe}")
        if type not in UNSIGNED:
            found = self.chosen(unsafe, self.emit(f"sub {kind} {zero}, {a}"), found, type, wide)
        return self.chosen(none, minus, found, type, wide)

    def converted(self, x: str, given: str, type: str, wide: bool) -> str:
        """A number of another type."""
        old, new = self.typed(given, wide), self.typed(type, wide)
        if type == "b":
            test = f"fcmp une {old}" if given in FLOATS else f"icmp ne {old}"
            return self.emit(f"{test} {x}, {self.known(0, given, wide)}")
        if given in FLOATS and type in FLOATS:
            return self.emit(f"{'fptrunc' if type == 'f32' else 'fpext'} {old} {x} to {new}")
        if type in FLOATS:
            return self.emit(f"{'u' if given in UNSIGNED else 's'}itofp {old} {x} to {new}")
        if given in FLOATS:
            name = "fptoui" if type in UNSIGNED else "fptosi"
            full = f"@llvm.{name}.sat.{self.suffix(type, wide)}.{self.suffix(given, wide)}"
            self.functions[full] = f"declare {new} {full}({old})"
            return self.emit(f"call {new} {full}({old} {x})")
        if BYTES[given] == BYTES[type] and given != "b":
            return x
        shorter = BYTES[type] < BYTES[given]
        how = "trunc" if shorter else "zext" if given in UNSIGNED else "sext"
        return self.emit(f"{how} {old} {x} to {new}")


COMPARED = {
    "eq": ("oeq", "eq", "eq"),
    "ne": ("une", "ne", "ne"),
    "lt": ("olt", "slt", "ult"),
    "le": ("ole", "sle", "ule"),
    "gt": ("ogt", "sgt", "ugt"),
    "ge": ("oge", "sge", "uge"),
}
"""Predicates for floats, integers with and without a sign."""

FLOAT_BINARY = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
BINARY = {
    "add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or", "xor": "xor",
    "shl": "shl", "shra": "ashr", "shrl": "lshr",
}  # fmt: skip
