"""LLVM's language for a graph: of one lane, or of vectors of lanes with masks.

The numbers that differ between lanes are vectors, the others stay numbers. A loop runs while any lane runs;
those that have ended keep what they have, under a mask. A branch is run if any lane takes it.
"""

from collections.abc import Callable, Sequence
from typing import Any

from natcoord_jax.native.graph import Branch, Buffer, Graph, Loop, Node, Pin, Region, Store, Test
from natcoord_jax.native.instructions import BYTES, LLVM, Instructions, memory_type, number
from natcoord_jax.native.lanes import Lanes
from natcoord_jax.native.liveness import Live, lasting

ON_STACK = 4096
"""Bytes of a buffer of one lane up to which it is on the stack."""

STRUCTURAL = frozenset(("const", "phi", "index", "merge"))
"""Nodes that are there where their loop or branch is."""


class Emitted:
    """The text of a function `body(in, out, work, lane)`.

    `in` and `out` are arrays of pointers: of inputs that differ between lanes and of outputs to arrays with
    an axis of lanes first. `lane` holds the numbers of the lanes.

    Args:
        graph: of the program.
        lanes: how many at once.
        varies: which inputs differ between lanes of a batch.
        name: of the function.

    Attributes:
        text: of the function, and of what it needs.
        work: bytes that it needs as `work`, aligned to 64.
    """

    def __init__(self, graph: Graph, lanes: int, varies: Sequence[bool], name: str = "body"):
        self.graph, self.lanes, self.varies = graph, lanes, list(varies)
        self.differ = Lanes(graph, varies if lanes > 1 else [False] * len(varies))
        self.live = Live(graph)
        self.ins = Instructions(lanes)
        self.work, self.constants = 0, []
        self.sizes = {b.place: b.size for b in graph.buffers if b.role == "output"}
        self.done: set[int] = set()
        self.external: dict[int, Node] = {}
        self.splats: dict[int, str] = {}
        self.region, self.mask, self.label = graph.top, "", "entry"
        self.names: dict[int, str] = {}
        self._head()
        self._items(graph.top)
        given = ", ".join(f"ptr noalias %{x}" for x in ("in", "out", "work", "lane"))
        lines = [
            f"define internal void @{name}({given}) {{",
            "entry:",
            *self.ins.lines,
            "ret void",
            "}",
        ]
        self.text = "\n".join([*self.constants, *lines, *self.ins.functions.values()])

    # Memory

    def _wide(self, buffer: Buffer) -> bool:
        return self.lanes > 1 and buffer in self.differ.buffers

    def _by_lane(self, buffer: Buffer) -> bool:
        """Whether its numbers are lane by lane, as outside."""
        return buffer.role == "output" or (buffer.role == "input" and self.varies[buffer.place])

    def _head(self) -> None:
        """Where memory is."""
        for lane in range(self.lanes):
            address = self.ins.emit(f"getelementptr i64, ptr %lane, i64 {lane}")
            self.names[-1 - lane] = self.ins.emit(f"load i64, ptr {address}")
        wide = self.lanes > 1
        self.number = self.names[-1]
        if wide:
            last = "poison"
            for lane in range(self.lanes):
                last = self.ins.emit(
                    f"insertelement {self._vector('i64')} {last}, i64 {self.names[-1 - lane]}, i32 {lane}"
                )
            self.number = last
        for buffer in self.graph.buffers:
            if buffer in self.live.buffers:
                self._place(buffer)

    def _vector(self, type: str) -> str:
        return f"<{self.lanes} x {type}>" if self.lanes > 1 else type

    def _place(self, buffer: Buffer) -> None:
        """Name the memory of a buffer."""
        name, kind = f"%b{buffer.number}", memory_type(buffer.type)
        lines = self.ins.lines
        if buffer.role == "constant":
            values = [number(x, "u8" if buffer.type == "b" else buffer.type) for x in _flat(buffer.place)]
            self.constants.append(
                f"@k{buffer.number} = private unnamed_addr constant [{len(values)} x {kind}] "
                f"[{', '.join(f'{kind} {x}' for x in values)}]"
            )
            lines.append(f"{name} = getelementptr i8, ptr @k{buffer.number}, i64 0")
        elif buffer.role == "work":
            width = self.lanes if self._wide(buffer) else 1
            element, size = (f"<{width} x {kind}>" if width > 1 else kind), buffer.size * BYTES[buffer.type]
            if size <= ON_STACK:
                lines.append(f"{name} = alloca {element}, i64 {max(buffer.size, 1)}, align 64")
            else:
                lines.append(f"{name} = getelementptr i8, ptr %work, i64 {self.work}")
                self.work += -(-size * width // 64) * 64
        else:
            table = "%in" if buffer.role == "input" else "%out"
            entry = self.ins.emit(f"getelementptr ptr, ptr {table}, i64 {buffer.place}")
            base = self.ins.emit(f"load ptr, ptr {entry}")
            if self._by_lane(buffer):
                index = self._vector("i64")
                many = self.ins.known(buffer.size, "i64", self.lanes > 1)
                moved = self.ins.emit(f"mul {index} {self.number}, {many}")
                lines.append(f"{name} = getelementptr {kind}, ptr {base}, {index} {moved}")
            else:
                lines.append(f"{name} = getelementptr i8, ptr {base}, i64 0")

    def _address(self, buffer: Buffer, address: Node) -> tuple[str, bool]:
        """Where a number is, and whether that is an address for each lane."""
        kind, name = memory_type(buffer.type), f"%b{buffer.number}"
        apart, wide = self.lanes > 1 and address in self.differ, self._wide(buffer)
        index = self._operand(address, apart)
        if self._by_lane(buffer) and self.lanes > 1:
            vector = self._vector("ptr")
            if address.is_const and not address.detail:
                return name, True
            of = f"{self._vector('i64')} {index}" if apart else f"i64 {index}"
            return self.ins.emit(f"getelementptr {kind}, {vector} {name}, {of}"), True
        if not apart:
            element = f"<{self.lanes} x {kind}>" if wide else kind
            if address.is_const and not address.detail:
                return name, False
            return self.ins.emit(f"getelementptr {element}, ptr {name}, i64 {index}"), False
        indices = self._vector("i64")
        if wide:
            many = self.ins.emit(f"mul {indices} {index}, splat (i64 {self.lanes})")
            own = "<" + ", ".join(f"i64 {k}" for k in range(self.lanes)) + ">"
            index = self.ins.emit(f"add {indices} {many}, {own}")
        return self.ins.emit(f"getelementptr {kind}, ptr {name}, {indices} {index}"), True

    def _load(self, node: Node) -> str:
        buffer, wide = node.detail, self.lanes > 1 and node in self.differ
        address, apart = self._address(buffer, node.args[0])
        kind = memory_type(buffer.type)
        if apart:
            vector, short = self._vector(kind), self._short(kind)
            full = f"@llvm.masked.gather.v{self.lanes}{short}.v{self.lanes}p0"
            flags = self._vector("i1")
            self.ins.functions[full] = (
                f"declare {vector} {full}({self._vector('ptr')}, i32, {flags}, {vector})"
            )
            found = self.ins.emit(
                f"call {vector} {full}({self._vector('ptr')} {address}, i32 {BYTES[buffer.type]}, "
                f"{flags} splat (i1 true), {vector} poison)"
            )
        else:
            whole = self._vector(kind) if wide else kind
            found = self.ins.emit(
                f"load {whole}, ptr {address}" + ("" if wide else f", align {BYTES[buffer.type]}")
            )
        if buffer.type == "b":
            found = self.ins.emit(
                f"trunc {self._vector('i8') if wide else 'i8'} {found} to {self.ins.typed('b', wide)}"
            )
        return found

    @staticmethod
    def _short(kind: str) -> str:
        return {"double": "f64", "float": "f32"}.get(kind, kind)

    def _store(self, item: Store) -> None:
        buffer, wide = item.buffer, self._wide(item.buffer)
        self._demand(item.value)
        self._demand(item.address)
        value = self._operand(item.value, wide)
        address, apart = self._address(buffer, item.address)
        kind = memory_type(buffer.type)
        if buffer.type == "b":
            value = self.ins.emit(
                f"zext {self.ins.typed('b', wide)} {value} to {self._vector('i8') if wide else 'i8'}"
            )
        mask = self.mask if wide and self.differ.apart(self.region, buffer) else ""
        size, vector, flags = BYTES[buffer.type], self._vector(kind), self._vector("i1")
        if apart:
            full = f"@llvm.masked.scatter.v{self.lanes}{self._short(kind)}.v{self.lanes}p0"
            pointers = self._vector("ptr")
            self.ins.functions[full] = f"declare void {full}({vector}, {pointers}, i32, {flags})"
            places = f"{pointers} {address}, i32 {size}, {flags} {mask or 'splat (i1 true)'}"
            self.ins.lines.append(f"call void {full}({vector} {value}, {places})")
        elif mask:
            full = f"@llvm.masked.store.v{self.lanes}{self._short(kind)}.p0"
            self.ins.functions[full] = f"declare void {full}({vector}, ptr, i32, {flags})"
            self.ins.lines.append(
                f"call void {full}({vector} {value}, ptr {address}, i32 {size * self.lanes}, {flags} {mask})"
            )
        else:
            end = "" if wide else f", align {size}"
            self.ins.lines.append(f"store {vector if wide else kind} {value}, ptr {address}{end}")

    # Numbers

    def _operand(self, node: Node, wide: bool) -> str:
        """A number that is there, in all lanes if asked for."""
        if node.is_const:
            return self.ins.known(node.detail, node.type, wide)
        name = self.names.get(node.number, f"%v{node.number}")
        if not wide or node in self.differ:
            return name
        if node.number not in self.splats:
            kind, vector = LLVM[node.type], self.ins.typed(node.type, True)
            first = self.ins.emit(f"insertelement {vector} poison, {kind} {name}, i32 0")
            self.splats[node.number] = self.ins.emit(
                f"shufflevector {vector} {first}, {vector} poison, <{self.lanes} x i32> zeroinitializer"
            )
        return self.splats[node.number]

    def _demand(self, node: Node) -> None:
        """Compute a node and what it needs, if they belong here; leave others to the region around."""
        stack = [node]
        while stack:
            x = stack[-1]
            if x.op in STRUCTURAL or x.number in self.done:
                stack.pop()
            elif x.home is not self.region:
                self.external[x.number] = x
                stack.pop()
            else:
                missing = [
                    y
                    for y in x.args
                    if y.op not in STRUCTURAL and y.number not in self.done and y.number not in self.external
                ]
                if missing:
                    stack.extend(reversed(missing))
                else:
                    stack.pop()
                    self._compute(x)

    def _compute(self, node: Node) -> None:
        self.done.add(node.number)
        wide = self.lanes > 1 and node in self.differ
        if node.op == "load":
            found = self._load(node)
        elif node.op == "convert":
            (x,) = node.args
            found = self.ins.converted(self._operand(x, wide), x.type, node.type, wide)
        elif node.op == "select":
            test, yes, no = node.args
            # Of vectors by one flag LLVM makes branches.
            which, kind = self._operand(test, wide), self.ins.typed(node.type, wide)
            flags = self.ins.typed("b", wide)
            a, b = self._operand(yes, wide), self._operand(no, wide)
            found = self.ins.emit(f"select {flags} {which}, {kind} {a}, {kind} {b}")
        else:
            args = [self._operand(x, wide) for x in node.args]
            found = self.ins.operation(node.op, node.type, node.args[0].type, wide, args)
        self._named(node, found)

    def _named(self, node: Node, found: str) -> None:
        """Let the last instruction have the name of its node, which other regions know."""
        last = self.ins.lines[-1] if self.ins.lines else ""
        if last.startswith(f"{found} = "):
            self.ins.lines[-1] = f"%v{node.number}{last[len(found) :]}"
        else:
            self._alias(node, found)

    def _alias(self, node: Node, found: str) -> None:
        kind = self.ins.typed(node.type, self.lanes > 1 and node in self.differ)
        self.ins.lines.append(f"%v{node.number} = bitcast {kind} {found} to {kind}")

    # Regions

    def _inside(
        self, region: Region, mask: str, label: str, act: Callable[[], None]
    ) -> tuple[list[str], str]:
        """The lines of a region, and the label that it ends in; what it needs of this one is computed."""
        outer = self.region, self.mask, self.label, self.ins.lines, self.external, self.splats
        self.region, self.mask, self.label = region, mask, label
        self.ins.lines, self.external, self.splats = [], {}, {}
        act()
        lines, last, needed = self.ins.lines, self.label, self.external
        self.region, self.mask, self.label, self.ins.lines, self.external, self.splats = outer
        for node in needed.values():
            self._demand(node)
        return lines, last

    def _items(self, region: Region) -> None:
        for item in lasting(region.items, self.live):
            if isinstance(item, Store):
                self._store(item)
            elif isinstance(item, Pin):
                self._demand(item.node)
            elif isinstance(item, Test):
                self._test(item)
            elif isinstance(item, Loop):
                self._loop(item)
            else:
                self._branch(item)

    def _starts(self, label: str) -> None:
        self.ins.lines.append(f"{label}:")
        self.label = label

    def _test(self, item: Test) -> None:
        self._demand(item.node)
        k = self.region.number
        if self.region in self.differ.parting:
            flags = self._vector("i1")
            running = self._operand(item.node, True)
            self.ins.lines.append(f"%m{k} = and {flags} %w{k}, {running}")
            test = self._any(f"%m{k}")
            self.mask = f"%m{k}"
        else:
            test = self._operand(item.node, False)
        self.ins.lines.append(f"br i1 {test}, label %body{k}, label %end{k}")
        self._starts(f"body{k}")

    def _any(self, mask: str) -> str:
        bits = self.ins.emit(f"bitcast {self._vector('i1')} {mask} to i{self.lanes}")
        return self.ins.emit(f"icmp ne i{self.lanes} {bits}, 0")

    def _loop(self, item: Loop) -> None:
        region, k = item.region, item.region.number
        parting = region in self.differ.parting
        live = [c for c in region.carries if c[0] in self.live]
        carries = [c for c in live if c[2] is not c[0]]
        following: list[str] = []
        trip = "" if region.index is None else f"%v{region.index.number}"

        def act() -> None:
            if item.count is not None:
                test = self.ins.emit(f"icmp slt i64 {trip}, {item.count}")
                self.ins.lines.append(f"br i1 {test}, label %body{k}, label %end{k}")
                self._starts(f"body{k}")
            self._items(region)
            for _, _, new in carries:
                self._demand(new)
            for node, _, new in carries:
                wide = self.lanes > 1 and node in self.differ
                found = self._operand(new, wide)
                if parting:
                    found = self.ins.chosen(f"%m{k}", found, f"%v{node.number}", node.type, wide)
                following.append(found)
            if item.count is not None:
                self.ins.lines.append(f"%n{k} = add nuw nsw i64 {trip}, 1")

        for node, first, new in live:
            self._demand(first)
            if new is node:
                self.names[node.number] = self._operand(first, self.lanes > 1 and node in self.differ)
        lines, last = self._inside(region, f"%w{k}" if parting else self.mask, f"head{k}", act)
        begins = [self._operand(first, self.lanes > 1 and node in self.differ) for node, first, _ in carries]
        before = self.label
        self.ins.lines.append(f"br label %head{k}")
        self.ins.lines.append(f"head{k}:")
        if item.count is not None:
            self.ins.lines.append(f"{trip} = phi i64 [0, %{before}], [%n{k}, %{last}]")
        if parting:
            start = self.mask or "splat (i1 true)"
            self.ins.lines.append(f"%w{k} = phi {self._vector('i1')} [{start}, %{before}], [%m{k}, %{last}]")
        for (node, *_), first, new in zip(carries, begins, following):
            kind = self.ins.typed(node.type, self.lanes > 1 and node in self.differ)
            self.ins.lines.append(f"%v{node.number} = phi {kind} [{first}, %{before}], [{new}, %{last}]")
        self.ins.lines += [*lines, f"br label %head{k}"]
        self._starts(f"end{k}")

    def _branch(self, item: Branch) -> None:
        kept = [k for k, merge in enumerate(item.merges) if merge in self.live]
        values = [[numbers[k] for k in kept] for numbers in item.values]
        item = Branch(item.chosen, item.regions, [item.merges[k] for k in kept], values)
        self._demand(item.chosen)
        if any(region in self.differ.parting for region in item.regions):
            self._some_lanes(item)
        else:
            self._all_lanes(item)

    def _case(self, item: Branch, k: int, mask: str) -> tuple[list[str], str, list[str]]:
        """The lines of a branch, where it ends, and its results."""
        region, results = item.regions[k], []

        def act() -> None:
            self._items(region)
            for node in item.values[k]:
                self._demand(node)
            for merge, node in zip(item.merges, item.values[k]):
                results.append(self._operand(node, self.lanes > 1 and merge in self.differ))

        lines, last = self._inside(region, mask, f"case{region.number}", act)
        return lines, last, results

    def _all_lanes(self, item: Branch) -> None:
        cases = [self._case(item, k, self.mask) for k in range(len(item.regions))]
        kind, chosen = LLVM[item.chosen.type], self._operand(item.chosen, False)
        labels = [f"case{region.number}" for region in item.regions]
        end = f"join{item.regions[0].number}"
        table = " ".join(f"{kind} {k}, label %{label}" for k, label in enumerate(labels[:-1]))
        self.ins.lines.append(f"switch {kind} {chosen}, label %{labels[-1]} [{table}]")
        for label, (lines, _, _) in zip(labels, cases):
            self.ins.lines += [f"{label}:", *lines, f"br label %{end}"]
        self._starts(end)
        for j, merge in enumerate(item.merges):
            wide = self.lanes > 1 and merge in self.differ
            given = ", ".join(f"[{results[j]}, %{last}]" for _, last, results in cases)
            self.ins.lines.append(f"%v{merge.number} = phi {self.ins.typed(merge.type, wide)} {given}")

    def _some_lanes(self, item: Branch) -> None:
        """One branch after the other, for the lanes that take it."""
        kind = self.ins.typed(item.chosen.type, True)
        chosen = self._operand(item.chosen, True)
        now = ["zeroinitializer"] * len(item.merges)
        for k, region in enumerate(item.regions):
            n = region.number
            mask = f"%m{n}"
            same = self.ins.known(k, item.chosen.type, True)
            outer = self.mask
            self.ins.lines.append(f"{'%c' + str(n) if outer else mask} = icmp eq {kind} {chosen}, {same}")
            if outer:
                self.ins.lines.append(f"{mask} = and {self._vector('i1')} {outer}, %c{n}")
            lines, last, results = self._case(item, k, mask)
            test, before = self._any(mask), self.label
            self.ins.lines.append(f"br i1 {test}, label %case{n}, label %join{n}")
            self.ins.lines += [f"case{n}:", *lines]
            mixed = []
            for merge, old, new in zip(item.merges, now, results):
                vector = self.ins.typed(merge.type, True)
                mixed.append(
                    new
                    if k == 0
                    else self.ins.emit(f"select {self._vector('i1')} {mask}, {vector} {new}, {vector} {old}")
                )
            self.ins.lines.append(f"br label %join{n}")
            self._starts(f"join{n}")
            for j, merge in enumerate(item.merges):
                name = f"%v{merge.number}" if k == len(item.regions) - 1 else f"%j{n}.{j}"
                vector = self.ins.typed(merge.type, True)
                self.ins.lines.append(f"{name} = phi {vector} [{now[j]}, %{before}], [{mixed[j]}, %{last}]")
                now[j] = name


def _flat(values: Any) -> Any:
    import numpy as np

    return np.asarray(values).reshape(-1)
