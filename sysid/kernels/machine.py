"""From LLVM assembly to object code for this machine, and from that to an address."""

from functools import cache
from typing import Any

import llvmlite
import llvmlite.binding as llvm

from sysid.kernels.vectormath import vector_functions

_LEVEL = 3
_engines: list[Any] = []  # an engine owns the memory of its code: it lives as long as the process


@cache
def _target() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features(), opt=_LEVEL, jit=True
    )


def _features() -> str:
    return str(llvm.get_host_cpu_features().flatten())


@cache
def machine_name() -> str:
    """What object code depends on besides its source: compiler, processor, vector library."""
    words = (llvmlite.__version__, str(llvm.llvm_version_info), llvm.get_host_cpu_name())
    return "\n".join((*words, _features(), *vector_functions().symbols.values()))


def object_code(assembly: str) -> bytes:
    """Compile assembly for this machine."""
    machine = _target()
    module = llvm.parse_assembly(assembly)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=_LEVEL)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return bytes(machine.emit_object(module))


def loaded(code: bytes, function: str) -> int:
    """Address of a function of some object code, which stays loaded."""
    _target()
    vector_functions()  # the code may call them
    empty = llvm.parse_assembly("")
    # each engine owns its target machine, so the one that compiles cannot be shared with it
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(empty, machine)
    engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _engines.append(engine)
    return int(engine.get_function_address(function))
