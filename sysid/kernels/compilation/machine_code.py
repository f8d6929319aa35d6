"""Compiling of LLVM assembly to object code, and loading of object code."""

from functools import cache
from typing import Any

import llvmlite
import llvmlite.binding as llvm

from sysid.kernels.vectors import load_vector_functions

_OPTIMIZATION_LEVEL = 3
_engines: list[Any] = []  # an engine owns the memory of its code: it lives as long as the process


@cache
def _create_target_machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=_list_cpu_features(),
        opt=_OPTIMIZATION_LEVEL,
        jit=True,
    )


def _list_cpu_features() -> str:
    return str(llvm.get_host_cpu_features().flatten())


@cache
def describe_machine() -> str:
    """Describe what object code depends on: compiler, processor, vector library."""
    words = (llvmlite.__version__, str(llvm.llvm_version_info), llvm.get_host_cpu_name())
    return "\n".join((*words, _list_cpu_features(), *load_vector_functions().symbols.values()))


def compile_assembly(assembly: str) -> bytes:
    """Compile assembly for this machine."""
    return bytes(_create_target_machine().emit_object(optimize_assembly(assembly)))


def optimize_assembly(assembly: str) -> Any:
    """Optimize assembly for this machine; return LLVM's module."""
    machine = _create_target_machine()
    module = llvm.parse_assembly(assembly)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=_OPTIMIZATION_LEVEL)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return module


def load_object_code(code: bytes, function: str) -> int:
    """Load object code, which stays loaded; return the address of a function."""
    _create_target_machine()
    load_vector_functions()  # the code may call them
    empty = llvm.parse_assembly("")
    # each engine owns its target machine, so the one that compiles cannot be shared with it
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(empty, machine)
    engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _engines.append(engine)
    return int(engine.get_function_address(function))
