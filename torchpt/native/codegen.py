"""LLVM IR to machine code, by llvmlite alone.

The file is also a program that compiles for another process (:mod:`torchpt.native.compilers` starts it), so it imports
nothing of this package: torch would take a second.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import sys
from typing import Any, NamedTuple

__all__ = ["Job", "compile_job", "llvm", "parse", "target_machine"]


class Job(NamedTuple):
    """A module to compile.

    Attributes:
        ir: the module in LLVM's text form, without triple and data layout.
        cpu: LLVM's name of the processor.
        features: LLVM's list of processor features.
        triple: of another machine; None: this one.
        threads: True: for a GPU; the code is PTX.
        quick: True: code that is ready in a third of the time, and runs 1.2 to 1.6 times as long, with the same results.
    """

    ir: str
    cpu: str
    features: str
    triple: str | None
    threads: bool
    quick: bool = False


@functools.cache
def llvm() -> Any:
    """Return llvmlite's binding, initialized for this machine."""
    import llvmlite.binding

    llvmlite.binding.initialize_native_target()
    llvmlite.binding.initialize_native_asmprinter()
    return llvmlite.binding


def target_machine(cpu: str, features: str, triple: str | None = None, opt: int = 2) -> Any:
    """Return a target machine of LLVM.

    Args:
        cpu: LLVM's name of the processor.
        features: LLVM's list of processor features.
        triple: of another machine; None: this one, for code that is loaded into a process (``jit``).
        opt: level of code generation, by default LLVM's: it selects instructions and registers, and runs no passes on the IR.
    """
    if triple is not None:
        llvm().initialize_all_targets()
        llvm().initialize_all_asmprinters()
    kind = llvm().Target.from_default_triple() if triple is None else llvm().Target.from_triple(triple)
    return kind.create_target_machine(cpu=cpu, features=features, opt=opt, jit=triple is None)


def parse(ir: str, machine: Any) -> Any:
    """Parse IR without triple and data layout; return the verified module, with those of a target machine."""
    # The layout comes before the instructions: LLVM gives loads and stores their alignment as it reads them.
    head = f'target datalayout = "{machine.target_data}"\ntarget triple = "{machine.triple}"\n'
    module = llvm().parse_assembly(head + ir)
    module.verify()
    return module


@functools.cache
def _machine_of(cpu: str, features: str, triple: str | None, threads: bool, quick: bool) -> Any:
    # Level 1 takes two thirds of the time of level 2 on large kernels; their code is as fast.
    return target_machine(cpu, features, triple, 0 if quick else 3 if threads else 1)


def compile_job(job: Job) -> bytes:
    """Compile a module to an object file, or for threads to the text of PTX."""
    binding, machine = llvm(), _machine_of(*job[1:])
    module = parse(job.ir, machine)
    # The IR is already vectorized and its constants are folded: LLVM's standard pipelines take three times as long as these
    # passes, and the code is no faster; kernels of GPUs then need more registers.
    passes = binding.create_new_module_pass_manager()
    if job.threads:
        passes.add_always_inliner_pass()
        passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    passes.add_new_gvn_pass()
    passes.add_aggressive_dce_pass()
    if job.threads:  # definitions of functions that were inlined
        passes.add_global_dead_code_eliminate_pass()
    passes.run(module, binding.create_pass_builder(machine, binding.create_pipeline_tuning_options()))
    return machine.emit_assembly(module).encode() if job.threads else machine.emit_object(module)


def main() -> None:
    """Compile the jobs of standard input, one a line as JSON, until it ends: to standard output a length and the code of each.

    A job that LLVM does not take ends the process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print must not mix with answers
    for line in sys.stdin.buffer:
        code = compile_job(Job(*json.loads(line)))
        answers.write(len(code).to_bytes(8, "little") + code)
        answers.flush()


if __name__ == "__main__":
    del sys.path[0]  # this folder, whose modules are named like others
    main()
