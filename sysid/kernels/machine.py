"""From LLVM assembly to an address: compiled for this machine, kept on disk as object code.

The cache folder is private to the user (mode 0700), because what lies there is run: a file that
somebody else owns, or whose digest does not fit, is thrown away and made again.
"""

import contextlib
import hashlib
import os
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm

from sysid.kernels.vectormath import vector_functions

_MAGIC = b"lagid-kernel-1\n"
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


def cache_folder() -> Path:
    """Folder of compiled kernels: `LAGID_CACHE_DIR`, or ``~/.cache/lagid``."""
    chosen = os.environ.get("LAGID_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "lagid"


def stored(key: str) -> bytes | None:
    """Object code kept under a key; None if there is none that can be trusted."""
    path = cache_folder() / f"{key}.o"
    try:
        with path.open("rb") as file:
            if hasattr(os, "getuid") and os.fstat(file.fileno()).st_uid != os.getuid():
                return None
            content = file.read()
    except OSError:
        return None
    header, digest, code = content[: len(_MAGIC)], content[len(_MAGIC) :][:32], content[47:]
    if header != _MAGIC or digest != hashlib.sha256(key.encode() + code).digest():
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    return code


def store(key: str, code: bytes) -> None:
    """Keep object code under a key; a folder that cannot be written to is no error."""
    folder = cache_folder()
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder):
            return
        digest = hashlib.sha256(key.encode() + code).digest()
        handle, temporary = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "wb") as file:
            file.write(_MAGIC + digest + code)
        os.replace(temporary, folder / f"{key}.o")  # whole or not at all


def _is_private(folder: Path) -> bool:
    """Whether nobody else may write there."""
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022
