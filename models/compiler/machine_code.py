"""Machine code from LLVM's intermediate code, kept on disk: assembled once, then loaded in a millisecond.

A file is a SHA-256 digest of the rest, a line of JSON and an object file for this computer's processor. It is written
atomically, so processes that start together do not disturb each other; a damaged file counts as missing. If the cache
cannot be written, everything works as without one.

What lies there is run: whoever can write it has the rights of whoever reads it, and a digest beside the code proves
nothing. So a file that somebody else could have written counts as missing (`models.own_files`).
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from upright.models.own_files import make_own, read_own

DIGEST = hashlib.sha256().digest_size


@dataclass(frozen=True, slots=True)
class Assembled:
    """Object code, and further facts about it (JSON)."""

    code: bytes
    facts: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Loaded:
    """Code in memory: addresses of functions, valid as long as `engine` lives."""

    addresses: Mapping[str, int]
    facts: Mapping[str, Any]
    engine: Any


def cache_directory() -> Path:
    """Where machine code is kept: UPRIGHT_CACHE, systemd's CACHE_DIRECTORY, or the user's cache."""
    for variable in ("UPRIGHT_CACHE", "CACHE_DIRECTORY"):
        if os.environ.get(variable):
            return Path(os.environ[variable].split(":")[0]) / "kernels"
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "upright" / "kernels"


def recall(name: str) -> Assembled | None:
    """The code that was kept under `name`; None if there is none, it is damaged, or others may have written it."""
    try:
        content = read_own(cache_directory(), name)
    except OSError:
        return None
    rest = content[DIGEST:]
    if hashlib.sha256(rest).digest() != content[:DIGEST]:
        return None
    line, _, code = rest.partition(b"\n")
    return Assembled(code, json.loads(line))


def keep(name: str, assembled: Assembled) -> None:
    """Keep `assembled` under `name`, if possible."""
    rest = json.dumps(dict(assembled.facts)).encode() + b"\n" + assembled.code
    path = cache_directory() / name
    try:
        make_own(path.parent)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            file.write(hashlib.sha256(rest).digest() + rest)
        os.replace(file.name, path)
    except OSError:
        return


def assemble(text: str, facts: Mapping[str, Any], *, optimise: bool = False) -> Assembled:
    """Machine code for this processor from intermediate code; `optimise` code that has not been optimised yet.

    Loops are neither unrolled nor vectorised: those that benefit are written that way already.
    """
    from llvmlite import binding  # type: ignore[import-untyped]

    machine, module = _machine(), binding.parse_assembly(text)
    if optimise:
        options = binding.create_pipeline_tuning_options(speed_level=2)
        options.loop_unrolling = options.loop_vectorization = options.slp_vectorization = False
        # Twice: only then all of numba's error handling is found to be unused; it would need numba when it is loaded.
        for _ in range(2):
            passes = binding.create_pass_builder(machine, options)
            passes.getModulePassManager().run(module, passes)
    return Assembled(machine.emit_object(module), facts)


def load(assembled: Assembled, functions: tuple[str, ...]) -> Loaded:
    """Load code into memory; `functions` are those whose addresses are needed."""
    from llvmlite import binding

    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
    engine.add_object_file(binding.ObjectFileRef.from_data(assembled.code))
    engine.finalize_object()
    return Loaded({name: engine.get_function_address(name) for name in functions}, assembled.facts, engine)


@functools.cache
def lanes() -> int:
    """Numbers that this processor computes at once; rows of sensitivities are padded to a multiple of it."""
    from llvmlite import binding

    return 8 if binding.get_host_cpu_features().get("avx512f") else 4


@functools.cache
def processor() -> str:
    """The target of the code: machine code for one processor need not run on another."""
    import llvmlite
    from llvmlite import binding

    features = binding.get_host_cpu_features().flatten()
    return f"{llvmlite.__version__} {binding.get_process_triple()} {binding.get_host_cpu_name()} {features}"


def _machine() -> Any:
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=2,
        reloc="default",
        codemodel="jitdefault",
        jit=True,
    )
