"""Machine code from LLVM's language, by llvmlite."""

import ctypes
import hashlib
from functools import cache
from typing import Any

import jax

from natcoord_jax.xla import kept


@cache
def binding() -> Any:
    """LLVM, ready to make code for this processor.

    Raises:
        ImportError: without llvmlite.
    """
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@cache
def target(level: int = 2) -> Any:
    """This processor, for code generated with so much effort."""
    llvm = binding()
    features = llvm.get_host_cpu_features().flatten()
    triple = llvm.Target.from_default_triple()
    return triple.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=level, jit=True, codemodel="jitdefault"
    )


MANY = 10_000
"""Statements from which on a group has at most four lanes. Numbers of so large programs are in memory; those
of eight lanes fill the first cache, and more lanes wait for the slowest.

Microseconds a lane-step of 64 lanes, 100 steps on an EPYC of Zen 4, by eight and by four: heavy top (2 900
statements) 0.29 and 0.33, controlled pendulum (7 300) 1.19 and 1.31, spacecraft (12 700) 1.39 and 1.19, open
tree (29 000) 7.3 and 6.2, four-bars (40 000) 3.3 and 2.5, rubbing balls (45 000) 4.6 and 4.2.
"""


def width(statements: int) -> int:
    """Lanes of a group, in programs of so many statements."""
    return min(_doubles(), 4 if statements >= MANY else 8)


@cache
def _doubles() -> int:
    """Doubles of a vector of this processor."""
    features = binding().get_host_cpu_features()
    return 8 if features.get("avx512f") else 4 if features.get("avx2") else 2


def object_code(text: str, level: int = 2) -> bytes:
    """The machine code of a module.

    Our own operations are folded, numbered and placed as they are made: loops are turned round, and what is
    next to each other is combined; more passes take more time and find nothing.
    """
    llvm = binding()
    module, machine = llvm.parse_assembly(text), target(level)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=level))
    passes = llvm.create_new_module_pass_manager()
    passes.add_loop_rotate_pass()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    passes.run(module, builder)
    return machine.emit_object(module)


class Loaded:
    """Machine code in this process; it stays as long as this is kept.

    Args:
        code: of a module.
    """

    def __init__(self, code: bytes):
        llvm = binding()
        self.engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target())
        self.engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
        self.engine.finalize_object()

    def capsule(self, name: str) -> Any:
        """A function as XLA takes it."""
        make = ctypes.pythonapi.PyCapsule_New
        make.restype, make.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
        return make(self.engine.get_function_address(name), None, None)

    def number(self, name: str) -> ctypes.c_int64:
        """A number that the code reads."""
        return ctypes.c_int64.from_address(self.engine.get_global_value_address(name))


_loaded: dict[str, Loaded] = {}
"""What XLA knows, by name; for good, since compiled programs may call it."""

_threads = [0]


def registered(text: str) -> str:
    """The name under which XLA knows the function `handler` of a module."""
    name = f"natcoord_jax_{hashlib.sha256(text.encode()).hexdigest()[:32]}"
    if name not in _loaded:
        request = f"{name} llvmlite {'.'.join(map(str, binding().llvm_version_info))}".encode()
        code = kept.get(request)
        if code is None:
            code = object_code(text)
            kept.put(request, code)
        _loaded[name] = loaded = Loaded(code)
        loaded.number("threads").value = _threads[0]
        jax.ffi.register_ffi_target(name, loaded.capsule("handler"), platform="cpu")
    return name


def set_threads(number: int) -> int:
    """Deal groups of lanes out over so many threads, 0 for as many as XLA has; returns what it was before."""
    before, _threads[0] = _threads[0], number
    for loaded in _loaded.values():
        loaded.number("threads").value = number
    return before
