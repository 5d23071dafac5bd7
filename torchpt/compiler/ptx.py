"""Compile LLVM IR to PTX, the assembly text that the driver of an NVIDIA GPU compiles to machine code.

llvmlite has LLVM's NVPTX target, so neither the CUDA toolkit nor a GPU is needed here. The text is of PTX 7.0 for compute
capability 7.5 and uses nothing newer: drivers since CUDA 11.0 compile it for any later GPU.
"""

from __future__ import annotations

from typing import Any

from torchpt.compiler.form import CAPACITY, Form
from torchpt.compiler.target import Target

__all__ = ["emit_ptx", "ptx_target"]

_TRIPLE = "nvptx64-nvidia-cuda"


def ptx_target(row: int = CAPACITY) -> Target:
    """Return the target of GPU kernels.

    Args:
        row: elements from one row of the GPU's arenas to the next, a constant in the code.
    """
    return Target(cpu="sm_75", features="+ptx70", triple=_TRIPLE, form=Form(width=1, row=row, threads=True))


def emit_ptx(llvm: Any, ir: str, target: Target) -> bytes:
    """Return the PTX of a module that :func:`torchpt.compiler.kernel.kernel_ir` wrote for threads.

    Args:
        llvm: llvmlite's binding.
        ir: text of the module, without target.
        target: from :func:`ptx_target`.
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(_TRIPLE).create_target_machine(cpu=target.cpu, features=target.features, opt=3)
    # The layout comes before the instructions: LLVM gives loads and stores their alignment as it reads them.
    head = f'target datalayout = "{machine.target_data}"\ntarget triple = "{_TRIPLE}"\n'
    module = llvm.parse_assembly(head + ir)
    module.verify()
    # The passes of CPU kernels; before them functions are inlined, behind them their definitions are removed. Kernels that
    # LLVM's standard pipelines compile need more registers.
    passes = llvm.create_new_module_pass_manager()
    passes.add_always_inliner_pass()
    passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    passes.add_new_gvn_pass()
    passes.add_aggressive_dce_pass()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_assembly(module).encode()
